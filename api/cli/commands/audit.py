"""`stimrig audit`: verify the audit trail against itself and what was noted of it elsewhere; export it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import Json, given, say, say_json, write
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.outbox import receipts
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.messages import PushError
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import AuditEntry

DataDir = Annotated[Path | None, typer.Option("--data", help="data folder; default ./var, or STIMRIG_DATA_DIR")]

NO_HEAD = "no entry has this hash; the trail was cut short or written anew"

HeadsFiles = Annotated[
    list[Path] | None, typer.Option(help="file written by `stimrig audit heads`, or one of receipts")
]


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Who did what, when, why: verify the chain of hashes, or export it.")
    verbs.command("verify")(verify)
    verbs.command("heads")(heads)
    verbs.command("export")(export)
    app.add_typer(verbs, name="audit")


def verify(
    data: DataDir = None,
    file: Annotated[Path | None, typer.Option(help="an exported file instead of the database")] = None,
    head: Annotated[str, typer.Option(help="hash that was noted elsewhere: it must be in the chain")] = "",
    heads: HeadsFiles = None,
    ask: Annotated[bool, typer.Option("--centre/--no-centre", help="ask the centre for what it countersigned")] = True,
    restored: Annotated[int, typer.Option(help="entry since which a restored database is known to lack some")] = 0,
    as_json: Json = False,
) -> None:
    """Exit 0 if the trail is whole; 1 if an entry was changed, removed or added."""
    settings = settings_of(data)
    entries = read_export(file) if file is not None else stored(settings)
    noted, wrong = outside(settings, file is None, heads or [])
    asked, centre = from_centre(settings) if ask and file is None else ([], "not asked")
    stands = receipts.standing(entries, noted + asked)
    missing = bool(head) and head not in {entry.hash for entry in entries}
    gone = stands.missing_since if stands.missing_since != restored else None
    last = entries[-1].hash if entries else audit.GENESIS
    found = {
        "whole": stands.first_broken is None and not missing and gone is None and not wrong,
        "first_broken": stands.first_broken, "missing_since": stands.missing_since, "head_found": not missing,
        "receipts": len({(one.key, one.seq, one.hash) for one in noted + asked}), "receipts_wrong": wrong,
        "centre": centre, "entries": len(entries), "head": last,
    }  # fmt: skip
    if as_json:
        say_json(found)
    else:
        say(
            "\n".join(
                [*words(stands, entries), *wrong, *([f"{head}: {NO_HEAD}"] if missing else []), length_words(found)]
            )
        )
    if not found["whole"]:
        raise typer.Exit(1)


def words(stands: receipts.Standing, entries: list[AuditEntry]) -> Iterator[str]:
    """What is wrong with the trail, a line each."""
    noted, broken, lost = stands.differs, stands.first_broken, stands.missing
    if noted is not None and noted.seq == broken:
        (now,) = [entry for entry in entries if entry.seq == broken]
        yield (
            f"entry {broken} is not the one that was {how(noted)}: it says now that {now.who} did "
            f"“{now.action}” to {now.subject or 'nothing'} on {now.at_utc}; its hash was {noted.hash}"
        )
    elif broken is not None:
        yield f"broken at entry {broken}: it, or one before it, was changed, taken out or put in"
    if lost is not None:
        yield (
            f"entries are missing since {lost.seq}, which was {how(lost)}: the trail was cut off, or the database "
            f"restored from a backup; where that is known, --restored {lost.seq} counts it no more"
        )


def how(noted: Receipt) -> str:
    """Who noted it, and when."""
    return f"countersigned by the centre on {noted.noted_utc}" if noted.key else f"noted on {noted.noted_utc}"


def length_words(found: dict[str, Any]) -> str:
    """The trail's length and head, and against what it was held."""
    length = f"{found['entries']} entries; head {found['head']}"
    held = f"compared with {found['receipts']} receipts and noted heads; centre: {found['centre']}"
    if found["whole"] and not found["receipts"]:
        held += "\nnote the head elsewhere (`stimrig audit heads`): else nobody sees a chain that was made anew"
    return f"{'whole: ' if found['whole'] else ''}{length}\n{held}"


def heads(
    data: DataDir = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="file to which a line is added; default: print it")
    ] = None,
) -> None:
    """The trail's present end: number and hash of the newest entry, and when it was noted; for `verify --heads`."""
    with open_store(settings_of(data)) as store:
        head = receipts.head(store, Clock())
    if output is None:
        say(head.model_dump_json(exclude_defaults=True))
        return
    try:
        receipts.append(output, [head])
    except OSError as error:
        raise InputError(f"{output}: {error.strerror}. Give a file that can be written.") from error


def outside(settings: Settings, of_rig: bool, named: list[Path]) -> tuple[list[Receipt], list[str]]:
    """What was noted of the trail outside the database, and what is wrong with those files."""
    own = receipts.files(settings.data_dir) if of_rig else []
    if of_rig and settings.heads_file is not None and settings.heads_file.exists():
        own.append(settings.heads_file)
    noted: list[Receipt] = []
    wrong: list[str] = []
    for path in [*own, *named]:
        try:
            kept, said = receipts.checked(path)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}. Give a file written by `stimrig audit heads`.") from error
        if path in named and not kept and not said:
            said = [f"{path}: no head is in it"]
        noted, wrong = noted + kept, wrong + said
    return noted, wrong


def from_centre(settings: Settings) -> tuple[list[Receipt], str]:
    """What the centre countersigned, and whether it answered."""
    if settings.centre_url is None or settings.centre_key is None:
        return [], "none is configured"
    noted: list[Receipt] = []
    with closing(Link(settings.centre_url, settings.centre_key.get_secret_value(), Clock())) as link:
        try:
            while more := link.heads(noted[-1].chain if noted else "", noted[-1].item if noted else 0):
                noted += more
        except PushError as error:
            return noted, str(error)
    return noted, "asked"


def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write: one JSON object a line")],
    data: DataDir = None,
) -> None:
    """Write the trail, one entry a line; `verify --file` checks it without the database."""
    entries = stored(settings_of(data))
    write(output, "".join(json.dumps(entry.as_dict(), sort_keys=True) + "\n" for entry in entries))
    say(f"{len(entries)} entries written to {output}; head {entries[-1].hash if entries else audit.GENESIS}")


def settings_of(data: Path | None) -> Settings:
    """The service's settings, perhaps with another data folder."""
    return Settings(**given(data_dir=data))


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
