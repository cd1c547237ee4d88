"""`python -m stimrig.rig.setup`: write a rig file; `stimrig rig init` starts it.

What was found and what is asked goes to standard error. Exit 2: an answer is wrong, or the file exists.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path

from stimrig.rig import config, devices
from stimrig.rig.adapters.machine import LocalMachine
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.errors import ConfigError, RigError
from stimrig.rig.limits import HARD_LIMITS, check
from stimrig.rig.setup import ports as found
from stimrig.rig.setup.questions import Question, questions
from stimrig.rig.setup.written import rig_file


def main(arguments: list[str] | None = None) -> int:
    ports, links = found.serial_ports(), found.can_interfaces()
    asked = questions(ports, links)
    parser = argparse.ArgumentParser(prog="python -m stimrig.rig.setup", description="Write a rig file.")
    parser.add_argument("-o", "--output", type=Path, default=Path("rig.toml"), help="the file; it must not exist")
    parser.add_argument("--yes", action="store_true", help="take the defaults of what no option answers")
    for question in asked:
        parser.add_argument(f"--{question.option}", metavar="TEXT", help=question.words.replace("%", "%%"))
    options = parser.parse_args(arguments)
    try:
        if options.output.exists():
            raise ConfigError(f"{options.output}: it exists, and is not overwritten; give another name with -o")
        _say(ports, links)
        answers = _answers(asked, options)
        _write(options.output, rig_file(answers, str(options.output)))
    except RigError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 2
    return 0


def _say(ports: list[found.Found], links: list[str]) -> None:
    lines = [f"{port.name}: {port.words}" for port in ports] + [f"{link}: CAN interface" for link in links]
    print(
        "found, without opening any:", *(lines or ["no serial port and no CAN interface"]), sep="\n  ", file=sys.stderr
    )


def _answers(asked: list[Question], options: argparse.Namespace) -> dict[str, str]:
    """By option; else the person's; else, with --yes, the default. Raises ConfigError."""
    answers: dict[str, str] = {}
    for question in asked:
        default = question.default(answers)
        answer: str | None = getattr(options, question.option.replace("-", "_"))
        if answer is None and not options.yes:
            if not sys.stdin.isatty():
                raise ConfigError(f"--{question.option}: nobody is there to ask; give it, or --yes for all defaults")
            print(f"? {question.words} [{default}]: ", end="", file=sys.stderr, flush=True)
            answer = sys.stdin.readline().strip() or None
        answers[question.option] = default if answer is None else answer
        if question.number:
            _check_number(question.option, answers[question.option])
    return answers


def _check_number(option: str, text: str) -> None:
    """A number; a limit is tighter than the hard one. Raises ConfigError."""
    try:
        value = float(text)
        if not math.isfinite(value):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--{option} {text}: this must be a number") from None
    row = HARD_LIMITS.get(option.removeprefix("limit-").replace("-", "_"))
    if row is not None and (refusal := check(row, value)) is not None:
        raise ConfigError(f"--{option} {text}: not tighter than the hard limit: {refusal}")


def _write(path: Path, text: str) -> None:
    """Check the file as the rig does, and only then give it its name. Raises ConfigError."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("x", encoding="utf-8") as file:
            file.write(text)
        try:
            chosen = config.load(draft)
            machine = LocalMachine(MonotonicClock())
            for kind, settings in chosen.devices().items():
                devices.find(kind, settings.device).create(settings, machine)
            machine.driver.end()
        except RigError as error:
            raise ConfigError(str(error).replace(str(draft), str(path))) from None
        os.link(draft, path)  # refuses where it exists
    except FileExistsError:
        raise ConfigError(f"{path}: it exists, and is not overwritten; give another name with -o") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; give a file in a folder that can be written") from None
    finally:
        draft.unlink(missing_ok=True)
    print(json.dumps({"rig_file": str(path), "devices": {kind: one.device for kind, one in chosen.devices().items()}}))


if __name__ == "__main__":
    sys.exit(main())
