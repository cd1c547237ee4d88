"""`stimrig recover`: seal a damaged or forgotten journal of the rig by hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError, LaunchError
from stimrig.api.cli.options import Json


def recover(
    journal: Annotated[Path, typer.Argument(help="a journal of the rig; it may be damaged", metavar="JOURNAL")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="folder for the recording")] = None,
    as_json: Json = False,
) -> None:
    """Make a sealed recording from a journal, and say what is missing. The journal is kept."""
    print(sealed(journal, output, as_json), end="")


def sealed(journal: Path, folder: Path | None, as_json: bool = True) -> str:
    """Seal it in a separate process and return its answer. Raises InputError, LaunchError: it cannot be sealed."""
    options = [*(["-o", str(folder)] if folder else []), *(["--json"] if as_json else [])]
    command = [sys.executable, "-m", "stimrig.rig.recover", *options, "--", str(journal)]
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode:
        words = (ended.stderr.strip().splitlines() or ["it ended without a message"])[-1].removeprefix("recover: ")
        raise InputError(words) if ended.returncode == 2 else LaunchError(words, ended.returncode)
    return ended.stdout
