"""`stimrig audit`: verify the audit trail's chain of hashes, or export it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy import make_url

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import check_outputs, write
from stimrig.api.cli.options import Json, set_options
from stimrig.api.cli.terminal import print_lines, report
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit
from stimrig.api.store.database import sqlite_file
from stimrig.api.store.tables import AuditEntry

DataDir = Annotated[Path | None, typer.Option("--data", help="data folder; default ./var, or STIMRIG_DATA_DIR")]
COLUMNS = {column.name for column in AuditEntry.__table__.columns}


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Who did what, when, why: verify the chain of hashes, or export it.")
    verbs.command("verify")(verify)
    verbs.command("export")(export)
    app.add_typer(verbs, name="audit")


def verify(
    data: DataDir = None,
    file: Annotated[Path | None, typer.Option(help="an exported file instead of the database")] = None,
    head: Annotated[str, typer.Option(help="hash that was noted elsewhere: it must be in the chain")] = "",
    as_json: Json = False,
) -> None:
    """Exit 0 if the trail is whole; 1 if an entry was changed, removed or added."""
    entries = stored(settings_of(data)) if file is None else read_export(file)
    broken = audit.first_broken(entries)
    missing = bool(head) and head not in {entry.hash for entry in entries}
    whole, last = broken is None and not missing, head_of(entries)
    document = {"whole": whole, "first_broken": broken, "head_found": not missing}
    lines = [f"{'whole: ' if whole else ''}{len(entries)} entries; head {last}"]
    if missing:
        lines.insert(0, f"{head}: no entry has this hash; the trail was cut short or written anew")
    if broken is not None:
        lines.insert(0, f"broken at entry {broken}: it, or one before it, was changed, taken out or put in")
    report(document | {"entries": len(entries), "head": last}, as_json, *lines)
    if not whole:
        raise typer.Exit(1)


def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write: one JSON object a line")],
    data: DataDir = None,
) -> None:
    """Write the trail, one entry a line; `verify --file` checks it without the database."""
    settings = settings_of(data)
    check_service_output(settings, [], output)
    entries = stored(settings)
    write(output, "".join(json.dumps(entry.as_dict(), sort_keys=True) + "\n" for entry in entries))
    print_lines(f"{len(entries)} entries written to {output}; head {head_of(entries)}")


def head_of(entries: list[AuditEntry]) -> str:
    """Return the hash of the last entry."""
    return entries[-1].hash if entries else audit.GENESIS


def settings_of(data: Path | None) -> Settings:
    """Return the service's settings, with another data folder where one is given."""
    return Settings(**set_options(data_dir=data))


def check_service_output(
    settings: Settings, inputs: Iterable[Path], output: Path | None, new_folder: Path | None = None
) -> None:
    """Check as `check_outputs` an output that may replace neither a file of the data folder nor the database."""
    database = sqlite_file(make_url(settings.database))
    files = [Path(f"{database}{suffix}") for suffix in ("", "-wal", "-shm", "-journal")] if database else []
    check_outputs([*inputs, *files], output, data_dir=settings.data_dir, new_folder=new_folder)


def open_store(settings: Settings) -> closing[Store]:
    """The database, let go at the end of a `with` statement. Raises InputError: there is none. ApiError."""
    place = settings.data_dir / "stimrig.db"
    if settings.database_url is None and not place.is_file():
        raise InputError(f"{place}: there is no database. Give the data folder with --data.")
    return closing(Store(settings.database))


def stored(settings: Settings) -> list[AuditEntry]:
    """The trail in the database, read only. Raises InputError, ApiError."""
    with open_store(settings) as store:
        return store.all(AuditEntry, order=AuditEntry.seq)


def read_export(path: Path) -> list[AuditEntry]:
    """An exported trail. Raises OSError; InputError: a line is no entry."""
    entries = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            fields = json.loads(line)
        except ValueError:
            fields = None
        if not isinstance(fields, dict) or set(fields) != COLUMNS:
            fix = "Give a file written by `stimrig audit export`."
            raise InputError(f"{path}, line {number}: no entry of an audit trail. {fix}")
        entries.append(AuditEntry(**fields))
    return entries
