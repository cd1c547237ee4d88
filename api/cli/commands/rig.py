"""`stimrig rig check`: check a rig's wiring, by a process of the rig's own package."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import Json
from stimrig.api.cli.supervisor import die_with_parent
from stimrig.api.cli.terminal import report


def rig(
    _action: Annotated[Literal["check"], typer.Argument(metavar="check", show_default=False)],
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML)", metavar="FILE")] = None,
    emulator_json: Annotated[
        str | None, typer.Option(help="line of `stimrig emulate`, or a file with it", metavar="LINE")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; overrides the rig file")] = None,
    questions: Annotated[bool, typer.Option(help="ask at the terminal what needs a person")] = True,
    as_json: Json = False,
) -> None:
    """Check devices, rates, zero, signs and one pulse into a dummy load. Exit 0: sound. 1: faults, or not complete."""
    if (rig is None) == (emulator_json is None):
        raise InputError("check: give one of --rig FILE and --emulator-json LINE.")
    words = ["--config", str(rig)] if rig is not None else ["--emulator-json", str(emulator_json)]
    words += [*(["--data", str(data)] if data else []), *([] if questions else ["--no-questions"])]
    before = signal.signal(signal.SIGINT, lambda *_: None)  # Ctrl-C is the child's: it stops the stimulator first
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "stimrig.rig.check", *words], stdout=subprocess.PIPE, text=True,
            preexec_fn=partial(die_with_parent, os.getpid(), signal.pthread_sigmask(signal.SIG_BLOCK, ())),
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGINT, before)
    if not ended.stdout:  # it has said why
        raise typer.Exit(max(ended.returncode, 1))
    document = json.loads(ended.stdout)
    report(document, as_json, *summary(document))
    raise typer.Exit(ended.returncode)


def summary(document: dict[str, Any]) -> list[str]:
    """Write the report for people: the verdict, and each fault with its remedy."""
    lines = [document["verdict"]]
    for step in document["steps"]:
        if step["outcome"] == "failed":
            lines += [f"{step['name']}: {step['figure']}: {step['cause']}", f"  -> {step['remedy']}"]
    undone = [step["name"] for step in document["steps"] if step["outcome"] == "not done"]
    return [*lines, *([f"not done: {', '.join(undone)}"] if undone else [])]
