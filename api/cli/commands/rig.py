"""`stimrig rig`: write a rig file, and check a rig with a dummy load or on the emulator.

Both are processes of the rig's own package, which this one starts: questions and progress go through to the terminal.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.child import die_with_parent
from stimrig.api.cli.errors import INTERRUPTED, InputError, LaunchError
from stimrig.api.cli.terminal import Json, say, say_json, write

INIT_SETTINGS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Write a rig file, or check a rig's wires, rates, signs and stops.")
    verbs.command("init", context_settings=INIT_SETTINGS, add_help_option=False)(init)
    verbs.command("check")(check)
    app.add_typer(verbs, name="rig")


def init(context: typer.Context) -> None:
    """Find ports and adapters, ask, and write a rig file with comments (--help lists the options)."""
    _child("stimrig.rig.setup", "setup", context.args, capture=False)


def check(
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML)", metavar="FILE")] = None,
    emulator_json: Annotated[
        str | None, typer.Option(help="line of `stimrig emulate`, or a file with it", metavar="LINE")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; overrides the rig file")] = None,
    dummy_load_ohm: Annotated[float, typer.Option(help="of the resistor on the cables")] = 1000.0,
    weight_nm: Annotated[float, typer.Option(help="torque of the known weight, N·m, flexion positive")] = 5.0,
    days: Annotated[float, typer.Option(help="after so many the check is due again")] = 30.0,
    by: Annotated[str | None, typer.Option(help="who does this check")] = None,
    answer: Annotated[
        list[str] | None, typer.Option(help="an answer to a question (docs/rig-check.md)", metavar="NAME=TEXT")
    ] = None,
    questions: Annotated[bool, typer.Option(help="ask at the terminal what only a person can see")] = True,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the certificate, a PDF file")] = None,
    as_json: Json = False,
) -> None:
    """Check each wire, rate, sign and stop of a rig on a dummy load. Exit 0: sound. 1: faults, or not complete."""
    if (rig is None) == (emulator_json is None):
        raise InputError("check: give one of --rig FILE and --emulator-json LINE.")
    place = ["--config", str(rig)] if rig is not None else ["--emulator-json", str(emulator_json)]
    words = [*place, "--dummy-load-ohm", str(dummy_load_ohm), f"--weight-nm={weight_nm}", "--days", str(days)]
    words += [f"--answer={one}" for one in [*([f"by={by}"] if by else []), *(answer or [])]]
    words += [*(["--data", str(data)] if data else []), *([] if questions else ["--no-questions"])]
    report = json.loads(_child("stimrig.rig.check", "check", words, capture=True))
    if output is not None:
        from stimrig.api.charts.certificate import certificate

        write(output, certificate(report))
    say_json(report) if as_json else say(*told(report))
    raise typer.Exit(0 if report["verdict"] == "sound" else 1)


def told(report: dict[str, Any]) -> list[str]:
    """The report for people: what is wrong with its mend, a line each."""
    lines = [f"{report['verdict']}: checked {report['checked_at_utc']} by {report['by']}"]
    for row in report["steps"]:
        if row["fault"]:
            lines += [f"{row['title']}: {row['cause']}", f"  -> {row['mend']}"]
    undone = [row["title"] for row in report["steps"] if row["outcome"] == "not done"]
    lines += [f"not done: {', '.join(undone)}"] if undone else []
    return [*lines, f"due again: {report['due_at_utc']:.10}"]


def _child(module: str, name: str, words: list[str], capture: bool) -> str:
    """Start a process of the rig; what it prints. It stops the stimulator before it ends.

    Ctrl-C is that one's. Where this one is killed it is told to end, and never plays on alone.

    Raises LaunchError, Exit.
    """
    command = [sys.executable, "-m", module, *words]
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        ended = subprocess.run(
            command, stdout=subprocess.PIPE if capture else None, text=True,
            preexec_fn=partial(die_with_parent, os.getpid(), signal.pthread_sigmask(signal.SIG_BLOCK, ())),
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGINT, before)
    if ended.returncode in (2, INTERRUPTED):
        raise typer.Exit(ended.returncode)  # it has said why
    if ended.returncode and not (capture and ended.stdout):
        raise LaunchError(f"{name}: it ended without a result", 1)
    return ended.stdout or ""
