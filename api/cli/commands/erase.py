"""`stimrig erase`: delete every row and file of a participant, and what the audit trail says of them.

Files go first, then all rows in one transaction: whatever ends the process, the same command goes on.
"""

from __future__ import annotations

import getpass
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import sqlalchemy as sa
import typer
from sqlalchemy.orm import Session

from stimrig.api.cli.commands.audit import DataDir, open_store, settings_of
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import Json, RigData
from stimrig.api.cli.terminal import report
from stimrig.api.clock import Clock
from stimrig.api.store import Store, audit, migrations
from stimrig.api.store.service_lock import HeldError, ServiceLock
from stimrig.api.store.tables import OPEN_STATES, Approval, Participant, Recording, Table, Test, Token
from stimrig.api.whole_file import to_disk

ELSEWHERE = "Backups, exports and prints may still hold the participant. Restore no such backup without erasing again."


def erase(
    code: Annotated[str, typer.Argument(help="the participant's code")],
    reason: Annotated[str, typer.Option(help="why, for the audit trail: no name, no code")] = "on request",
    data: DataDir = None,
    rig_data: RigData = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask before deleting")] = False,
    as_json: Json = False,
) -> None:
    """Delete recordings, models, tests, notes, limits and keys of a participant; the service must be stopped."""
    if code and code in reason:
        raise InputError("--reason: it stays in the audit trail. Give one that does not name the participant.")
    if not yes and (as_json or not sys.stdin.isatty()):
        raise InputError("Nothing was deleted. Add --yes to delete without being asked.")
    settings, clock, by = settings_of(data), Clock(), f"command line ({getpass.getuser()})"
    with open_store(settings) as store, ExitStack() as stack:
        try:
            stack.callback(ServiceLock(settings).release)
        except HeldError as error:
            raise InputError(f"{error}. Stop the service first.") from error
        files = find_files(store, code, [settings.data_dir, rig_data or settings.data_dir], clock.utc())
        if not yes:
            typer.confirm(f"Delete {code} with {len(files)} files for good?", abort=True)
        for path in files:
            path.unlink(missing_ok=True)
            to_disk(path.parent)
        with store.write() as session:
            rows = find_rows(session, code)
            for table, keys in reversed(rows.items()):
                session.execute(sa.delete(table).where(key_of(table).in_(keys)))
            names = {code, *(key for keys in rows.values() for key in keys if isinstance(key, str))}
            counts = {table.name: len(keys) for table, keys in rows.items() if keys}
            audit.erase(session, names, clock.utc(), by, reason=reason, rows=counts)
        store.compact()
    words = f"deleted: {len(files)} files, {', '.join(f'{count} {name}' for name, count in counts.items())}"
    report({"rows": counts, "files": len(files)}, as_json, words, ELSEWHERE)


def find_files(store: Store, code: str, folders: list[Path], now_utc: str) -> list[Path]:
    """Return the participant's files below the data folders, and the copies of the database from before upgrades.

    Raises InputError: there is no such participant; a test goes on; a controller may still use the participant's model;
    a recording lies outside of the folders.
    """
    with store.read() as session:
        if session.get(Participant, code) is None:
            raise InputError(f"{code}: there is no participant of this code.")
        if (test := session.scalars(sa.select(Test).where(Test.state.in_(OPEN_STATES))).first()) is not None:
            raise InputError(f"Test {test.id} is {test.state}. Start the service, and wait for the end of the test.")
        decisions = session.scalars(sa.select(Approval).where(Approval.participant == code).order_by(Approval.id))
        newest = {decision.model_id: decision for decision in decisions}
        valid: list[Any] = [decision for decision in newest.values() if decision.approved]
        valid += session.scalars(sa.select(Token).where(Token.participant == code, Token.revoked.is_(False)))
        if any(row.expires_utc is None or row.expires_utc > now_utc for row in valid):
            raise InputError(f"{code}: a controller may use a model. Reject it and revoke the keys on the page first.")
        tests = set(session.scalars(sa.select(Test.id).where(Test.participant == code)))
        named = [Path(path) for path in session.scalars(sa.select(Recording.path).where(Recording.participant == code))]
    names = {path.name for path in named}
    roots = [(folder / kind).resolve() for folder in folders for kind in ("recordings", "journals")]
    below = [path for root in roots for path in root.rglob("*") if path.resolve() == path]  # through no link
    files = {path for path in below if path.name in names or test_of(path) in tests}
    for path in named:
        if path.is_file() and path.resolve() not in files:
            raise InputError(f"{path}: it is in none of the data folders. Name its folder with --rig-data.")
    database = store.engine.url.database
    return sorted(files.union((Path(database).parent / migrations.BEFORE).glob("*")) if database else files)


def test_of(path: Path) -> str:
    """Return the id of the test whose recording (`<time>Z_<test>.h5`) or journal a file is."""
    return path.name.rpartition("Z_")[2].partition(".")[0]


def find_rows(session: Session, code: str) -> dict[sa.Table, list[Any]]:
    """Return the keys of the participant's rows, and of rows that refer to them, by table; parents first."""
    rows: dict[sa.Table, list[Any]] = {}
    for table in Table.metadata.sorted_tables:
        conditions = [column == code for column in table.c if column.name == "participant"]
        keys = [(column, key.column.table) for column in table.c for key in column.foreign_keys]
        conditions += [column.in_(rows[parent]) for column, parent in keys if parent in rows]
        if table.name == Participant.__tablename__:
            conditions = [table.c.code == code]
        if conditions:
            rows[table] = list(session.scalars(sa.select(key_of(table)).where(sa.or_(*conditions)).distinct()))
    return rows


def key_of(table: sa.Table) -> sa.Column[Any]:
    """Return the first column of a table's primary key."""
    return next(iter(table.primary_key))
