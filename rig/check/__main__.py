"""`python -m stimrig.rig.check`: check a rig on a dummy load or the emulator; `stimrig rig check` starts it.

Progress and questions go to standard error, the report as one JSON object to standard output. Exit 0: sound. 1: faults
were found, or something that is needed was not done. 2: bad input, or another process uses the rig.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import wait
from pathlib import Path
from typing import Any

from stimrig.rig import config as configuration
from stimrig.rig.adapters.files import Files
from stimrig.rig.adapters.machine import LocalMachine
from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Finding
from stimrig.rig.check.person import QUESTIONS, AtTerminal, Hands, Person, Scripted, control_line
from stimrig.rig.check.running import emulated_outputs, file_sha256, run
from stimrig.rig.check.surroundings import Surroundings
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.control.checked import CHECK_FILE
from stimrig.rig.errors import ConfigError, RigError

CLOSED_WITHIN_S = 45.0
"""Real seconds for the stop, its evidence and the sealing of a train that was interrupted."""
INTERRUPTED = 130
ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends a process: Ctrl-C, the system, and a terminal that is closed, which is told by two of them at once."""
EAR_S = 0.1
"""A signal that another thread of this process has taken is heard after so long."""
MARKS = {"passed": "ok", "failed": "FAULT", "not done": "--"}


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.CRITICAL)
    before = {one: signal.signal(one, _end) for one in ENDS}  # each stops the stimulator first
    try:
        for name, number in (("--dummy-load-ohm", options.dummy_load_ohm), ("--days", options.days)):
            if not (0 < number < 1e6):
                raise ConfigError(f"{name}: {number:g} is no number above 0 and below 1 000 000")
        if not (0.1 <= abs(options.weight_nm) <= 40):
            raise ConfigError(f"--weight-nm: {options.weight_nm:g} is not between 0.1 and 40")
        config = configuration.chosen(options, data_dir=options.data, socket=Path("check.sock"))
        assert config is not None
        report = _checked(config, options)
    except RigError as error:
        print(f"check: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("check: interrupted; the stimulator was stopped", file=sys.stderr)
        return INTERRUPTED
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    print(json.dumps(report, ensure_ascii=False))
    return 0 if report["verdict"] == "sound" else 1


def _end(*_: object) -> None:
    """The first signal ends the check; none that follows it cuts the stop short."""
    for one in ENDS:
        signal.signal(one, lambda *_: None)
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m stimrig.rig.check", description="Check a rig.")
    configuration.add_arguments(parser, required=True, about="rig file (TOML), see docs/rig-file.md")
    parser.add_argument("--data", type=Path, help="data folder; overrides the rig file")
    parser.add_argument("--dummy-load-ohm", type=float, default=1000.0, help="of the resistor on the cables")
    parser.add_argument("--weight-nm", type=float, default=5.0, help="torque of the known weight, flexion positive")
    parser.add_argument("--days", type=float, default=30.0, help="after so many the check is due again")
    parser.add_argument("--answer", action="append", default=[], metavar="NAME=TEXT", help=", ".join(QUESTIONS))
    parser.add_argument("--no-questions", action="store_true", help="what only a person can see is not done")
    return parser


def _checked(config: configuration.RigConfig, options: argparse.Namespace) -> dict[str, Any]:
    """The report. After Ctrl-C the rig is stopped and closed before this ends."""
    machine, person = LocalMachine(MonotonicClock(config.clock_speed)), _person(config, options)
    about = dict[str, Any]()
    if options.config is not None:
        about = {"rig_file": str(options.config), "rig_file_sha256": file_sha256(options.config.read_bytes())}
    with _nobody_else(config.data_dir):
        bench = Bench(
            config, machine, person, Surroundings(), time.sleep, options.config is None, options.dummy_load_ohm,
            options.weight_nm,
        )  # fmt: skip
        ask = machine.driver.ask
        try:
            asked = ask(lambda: run(bench, options.days, about, _tell))
            while not wait([asked], EAR_S).done:
                pass
            return asked.result()
        except KeyboardInterrupt:
            if not wait([ask(bench.rig.close)], CLOSED_WITHIN_S).done:
                raise RigError("interrupted, and no sign that the stimulator has stopped: switch it off") from None
            raise
        finally:
            machine.driver.end()
            give_to_owner(config.data_dir)


def give_to_owner(folder: Path) -> None:
    """What root has made in a data folder is its owner's, whose rig reads it."""
    if os.geteuid() == 0 and folder.exists():
        owner = folder.stat()
        for place in (folder / CHECK_FILE, folder / "rig.lock", folder / "check"):
            with contextlib.suppress(FileNotFoundError):
                os.chown(place, owner.st_uid, owner.st_gid, follow_symlinks=False)
        if (folder / "check").is_symlink():  # its owner could name any folder of root's
            return
        for _, folders, files, here in os.fwalk(folder / "check", follow_symlinks=False):
            for name in (*folders, *files):
                with contextlib.suppress(FileNotFoundError):
                    os.chown(name, owner.st_uid, owner.st_gid, dir_fd=here, follow_symlinks=False)


@contextlib.contextmanager
def _nobody_else(folder: Path) -> Iterator[None]:
    """Lock the data folder as a rig process does. Raises BusyError: one uses it. Where it cannot be, a step says so."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            stack.enter_context(Files().lock(folder))
        yield


def _tell(title: str, finding: Finding) -> None:
    bound = f"  (must be: {finding.bound})" if finding.bound else ""
    print(f"{MARKS[finding.outcome]:6} {title}: {finding.figure}{bound}", file=sys.stderr, flush=True)


def _person(config: configuration.RigConfig, options: argparse.Namespace) -> Person:
    answers = dict[str, str]()
    for text in options.answer:
        name, equals, answer = text.partition("=")
        if not equals or name.partition(":")[0] not in QUESTIONS:
            raise ConfigError(f"--answer {text}: write NAME=TEXT; the names are {', '.join(QUESTIONS)}")
        answers[name] = answer
    other: Person | None = None
    if options.config is None:
        text = options.emulator_json
        line = json.loads(text if text.lstrip().startswith("{") else Path(text).read_text("utf-8"))
        other = Hands(control_line(line["control"]), emulated_outputs(line, config)) if "control" in line else None
    elif not options.no_questions and sys.stdin.isatty():
        other = AtTerminal()
    return Scripted(answers, other)


if __name__ == "__main__":
    sys.exit(main())
