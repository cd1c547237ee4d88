"""`stimrig backup`: make a backup of database and recordings, restore it for trial and compare, put it back."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.errors import CommandError
from stimrig.api.cli.terminal import Json, say, say_json
from stimrig.api.clock import Clock
from stimrig.api.operation import state
from stimrig.api.operation.copying import BackupError, manifest, size_of
from stimrig.api.progress_bar import progress_bar

RIG_DATA, API_DATA = Path("/var/lib/stimrig/rig"), Path("/var/lib/stimrig/api")
RigData = Annotated[Path, typer.Option(help="the rig's data folder; of `stimrig serve` the same for both")]
ApiData = Annotated[Path, typer.Option("--data", help="the service's data folder, with the database")]
Backup = Annotated[Path, typer.Argument(help="folder that `stimrig backup create` has made", metavar="BACKUP")]


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Make a backup, restore it for trial, put it back.")
    verbs.command("create")(create)
    verbs.command("verify")(verify)
    verbs.command("restore")(restore)
    app.add_typer(verbs, name="backup")


def create(
    to: Annotated[Path, typer.Option(help="folder for backups, best on another disk")],
    rig_data: RigData = RIG_DATA,
    api_data: ApiData = API_DATA,
    as_json: Json = False,
) -> None:
    """A checked copy of database, recordings, journals and latch; also while a test runs."""
    from stimrig.api.operation import backup

    with one_line(), progress_bar() as tell:
        done = backup.create(rig_data, api_data, to, tell)
        made, size = manifest(done), size_of(done)
    with suppress(OSError):  # the backup is there all the same
        state.note(api_data, created_utc=made["created_utc"], created_bytes=size)
    found = {"backup": str(done), "files": len(made["sha256"]), "bytes": size}
    tell_found(found, f"{done}: {found['files']} files, {size / 1e6:.1f} MB, each with its SHA-256", as_json)


def verify(
    backup: Backup,
    place: Annotated[Path | None, typer.Option(help="folder to restore it in for trial; default: beside it")] = None,
    api_data: ApiData = API_DATA,
    as_json: Json = False,
) -> None:
    """Restore a backup into a new place, compare all of it, remove the place. Exit 1: something does not hold."""
    from stimrig.api.operation import drill

    now = Clock().utc()
    try:
        with one_line(), progress_bar() as tell:
            found = drill.verify(backup, place, tell)
    except CommandError as error:
        if error.exit_code == 1:  # else nothing was tried
            _note(api_data, failed_utc=now, problem=str(error))
        raise
    told = {"verified_utc": now, "verified_of_utc": found.created_utc, "verified_s": found.seconds}
    noted = _note(api_data, **told, failed_utc="", problem="")
    words = [
        f"restored and compared in {found.seconds:g} s: {found.files_same} files ({found.bytes / 1e6:.1f} MB) with the "
        "same SHA-256",
        f"database: sound, {found.rows} rows{', as when it was made' if found.rows_compared else ''}",
        f"{found.recordings} recordings opened, {found.models} models read",
        *([] if noted else [f"not noted: {api_data} is not there, or may not be written"]),
    ]
    tell_found(found.as_dict() | {"noted": noted}, "\n".join(words), as_json)


def _note(api_data: Path, **told: Any) -> bool:
    """Keep when it was tried, for `stimrig doctor` and the service's figures; False: there is no place for it."""
    try:
        state.note(api_data, **told)
    except OSError:
        return False
    return True


def restore(
    backup: Backup,
    rig_data: RigData = RIG_DATA,
    api_data: ApiData = API_DATA,
    force: Annotated[bool, typer.Option("--force", help="where data are: set them aside, then restore")] = False,
    as_json: Json = False,
) -> None:
    """Put a backup back: into empty data folders, or with what is there set aside. The rig comes up latched."""
    from stimrig.api.operation import restore as back
    from stimrig.api.operation.copying import Meter

    with one_line(), progress_bar() as tell:
        words = back.restore(backup, rig_data, api_data, force, Meter(tell, 3 * size_of(backup))).words
    tell_found({"restored": words}, "\n".join(words), as_json)


def tell_found(found: dict[str, Any], words: str, as_json: bool) -> None:
    """One object, or lines for people."""
    say_json(found) if as_json else say(words)


@contextmanager
def one_line() -> Iterator[None]:
    """What goes wrong, as a line and an exit code."""
    try:
        yield
    except BackupError as error:
        raise CommandError(str(error), error.code) from error
    except (OSError, sqlite3.Error) as error:
        raise CommandError(str(error)) from error
