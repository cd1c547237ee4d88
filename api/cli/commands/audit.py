"""`stimrig audit`: verify the audit trail's chain of hashes, or export it."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import write
from stimrig.api.cli.options import Json, set_options
from stimrig.api.cli.terminal import say, say_json
from stimrig.api.errors import ApiError
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import AuditEntry

DataDir = Annotated[Path | None, typer.Option("--data", help="data folder; default ./var, or STIMRIG_DATA_DIR")]

NO_HEAD = "no entry has this hash; the trail was cut short or written anew"


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
    entries = read_export(file) if file is not None else stored(settings_of(data))
    broken = audit.first_broken(entries)
    missing = bool(head) and head not in {entry.hash for entry in entries}
    last = entries[-1].hash if entries else audit.GENESIS
    report = {
        "whole": broken is None and not missing, "first_broken": broken, "head_found": not missing,
        "entries": len(entries), "head": last,
    }  # fmt: skip
    if as_json:
        say_json(report)
    else:
        lines = [f"{'whole: ' if report['whole'] else ''}{len(entries)} entries; head {last}"]
        if missing:
            lines.insert(0, f"{head}: {NO_HEAD}")
        if broken is not None:
            lines.insert(0, f"broken at entry {broken}: it, or one before it, was changed, taken out or put in")
        say("\n".join(lines))
    if not report["whole"]:
        raise typer.Exit(1)


def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write: one JSON object a line")],
    data: DataDir = None,
) -> None:
    """Write the trail, one entry a line; `verify --file` checks it without the database."""
    entries = stored(settings_of(data))
    write(output, "".join(json.dumps(entry.as_dict(), sort_keys=True) + "\n" for entry in entries))
    say(f"{len(entries)} entries written to {output}; head {entries[-1].hash if entries else audit.GENESIS}")


def settings_of(data: Path | None) -> Settings:
    """Return the service's settings, with another data folder where one is given."""
    return Settings(**set_options(data_dir=data))


def open_store(settings: Settings) -> closing[Store]:
    """The database, let go at the end of a `with` statement. Raises InputError: there is none."""
    place = settings.data_dir / "stimrig.db"
    if settings.database_url is None and not place.is_file():
        raise InputError(f"{place}: there is no database. Give the data folder with --data.")
    try:
        return closing(Store(settings.database))
    except ApiError as error:
        raise InputError(str(error)) from error


def stored(settings: Settings) -> list[AuditEntry]:
    """The trail in the database, read only. Raises InputError."""
    with open_store(settings) as store:
        return store.all(AuditEntry, order=AuditEntry.seq)


def read_export(path: Path) -> list[AuditEntry]:
    """An exported trail. Raises InputError: the file cannot be read, or a line is no entry."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}. Give a file written by `stimrig audit export`.") from error
    columns = {column.name for column in AuditEntry.__table__.columns}
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            fields = json.loads(line)
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}: no JSON. Give a file written by `stimrig audit export`."
            ) from error
        if not isinstance(fields, dict) or set(fields) != columns:
            raise InputError(f"{path}, line {number}: no entry of an audit trail.")
        entries.append(AuditEntry(**fields))
    return entries
