"""`stimrig upgrade`: data of an older version brought to this one, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import Json, given, say, say_json


def upgrade(
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    rig_data: Annotated[Path | None, typer.Option(help="the rig's data folder, where it is another one")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig file; on the way back: which of its keys are new")] = None,
    database: Annotated[str | None, typer.Option(help="URL of the database; or STIMRIG_DATABASE_URL")] = None,
    back: Annotated[bool, typer.Option("--back", help="to the data of version 0.1: install it afterwards")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be done, and change nothing")] = False,
    copied: Annotated[bool, typer.Option("--copied", help="PostgreSQL: a backup was made by pg_dump")] = False,
    as_json: Json = False,
) -> None:
    """Bring the data of an older version to this one, or back. Exit 1: it is done, but a recording is in doubt."""
    from stimrig.api.clock import Clock
    from stimrig.api.progress_bar import progress_bar
    from stimrig.api.settings import Settings
    from stimrig.api.upgrade import Request, UpgradeError
    from stimrig.api.upgrade import upgrade as run

    settings = Settings(**given(data_dir=data, database_url=database))
    request = Request(back=back, dry_run=dry_run, copied=copied, rig_data=rig_data, rig_file=rig)
    try:
        with progress_bar() as tell:
            found = run(settings, request, Clock(), tell)
    except UpgradeError as error:
        raise InputError(str(error)) from error
    if as_json:
        say_json(found)
    else:
        say(*_lines(found))
    if found["doubts"]:
        raise typer.Exit(1)


def _lines(found: dict[str, object]) -> list[str]:
    told, doubts, notes = ([str(one) for one in list(found[name])] for name in ("told", "doubts", "notes"))  # pyright: ignore[reportCallIssue, reportArgumentType]
    if found["from"] == found["to"]:
        return [f"the data are at {found['to']} already", *notes]
    did = "would go" if found["dry_run"] else "went"
    lines = [f"the database {did} from {found['from']} to {found['to']}"]
    lines += [f"as it was before: {found['copy']}"] if found["copy"] else []
    lines += [*told, *notes]
    return lines + (doubts or ([] if found["dry_run"] else ["audit trail and recordings are whole"]))
