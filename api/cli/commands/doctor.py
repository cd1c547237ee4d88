"""`stimrig doctor`: what on this machine keeps a rig from working, and how to fix it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli import doctor as checks
from stimrig.api.cli.terminal import Json, given, say, say_json
from stimrig.api.settings import Settings

MARKS = {"ok": "ok   ", "care": "care ", "fails": "FAILS"}


def doctor(
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: STIMRIG_RIG_FILE")] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    socket: Annotated[Path | None, typer.Option(help="a running rig's socket, or STIMRIG_RIG_SOCKET")] = None,
    as_json: Json = False,
) -> None:
    """Check devices, permissions, clock, disk, priority; say how to fix each. Sends nothing. Exit 1 if one fails."""
    found = checks.examine(Settings(**given(rig_file=rig, data_dir=data, rig_socket=socket)))
    report = checks.as_dict(found)
    if as_json:
        say_json(report)
    else:
        for finding in found:
            say(f"{MARKS[finding.verdict]}  {finding.check:14} {finding.says}")
            if finding.verdict != "ok" and finding.fix:
                say(f"{'':23}-> {finding.fix}")
    if report["verdict"] == "fails":
        raise typer.Exit(1)
