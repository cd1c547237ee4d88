"""An upgrade, or the way back: each step is done or not, and a call after a kill goes on with the next one.

`upgrade.json` in the data folder says which steps of a run are done; it is gone once all are.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Connection, Engine
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import audit, copies, database, downgrades, migrations
from stimrig.api.store.migrations import BEFORE, NEWEST, WRITES
from stimrig.api.store.tables import AuditEntry, Recording
from stimrig.api.upgrade import places
from stimrig.api.upgrade.places import UpgradeError
from stimrig.api.whole_file import sha256_of, whole_file

STATE = "upgrade.json"
WHO = "stimrig upgrade"
Tell = Callable[[float, str], None]


@dataclass(frozen=True)
class Request:
    """What is asked for.

    `rig_data`: the rig's data folder, where it is another one; `rig_file`: to be looked at on the way back;
    `copied`: somebody vouches for a backup of a PostgreSQL database.
    """

    back: bool = False
    dry_run: bool = False
    copied: bool = False
    rig_data: Path | None = None
    rig_file: Path | None = None


def upgrade(
    settings: Settings, request: Request, clock: Clock, tell: Tell = lambda _share, _text: None
) -> dict[str, Any]:
    """Upgrade the data of a service and its rig, or go back; what was done, as `stimrig upgrade --json` has it.

    Raises UpgradeError: it cannot be done, and nothing was changed.
    """
    rig_data = request.rig_data or settings.data_dir
    told = places.notes(rig_data, request.rig_file, request.back)
    if request.dry_run:
        return _tried(settings, request, clock) | {"notes": told}
    with places.held(settings, rig_data):
        if request.back:
            places.refuse_unsealed(rig_data)
        run = _Run(settings, request, clock, tell)
        try:
            return run.all_steps() | {"notes": told}
        finally:
            run.engine.dispose()


def _tried(settings: Settings, request: Request, clock: Clock) -> dict[str, Any]:
    """What would be done, found out on a copy: a service may go on meanwhile."""
    path = database.sqlite_file(make_url(settings.database))
    if path is None:
        raise UpgradeError("--dry-run tries it on a copy, which needs SQLite; restore a pg_dump, and upgrade that")
    if not path.is_file():
        raise UpgradeError(f"{path}: there is no database; give the data folder with --data")
    with tempfile.TemporaryDirectory(prefix="stimrig-upgrade-") as folder:
        copy = Path(folder) / path.name
        _or_refuse(lambda: copies.copy_database(path, copy))
        run = _Run(Settings(data_dir=Path(folder), database_url=f"sqlite:///{copy}"), request, clock, lambda *_: None)
        try:
            return {
                "from": run.at,
                "to": run.to,
                "dry_run": True,
                "copy": None,
                "told": run.change_database(),
                "doubts": [],
            }
        finally:
            run.engine.dispose()


class _Run:
    def __init__(self, settings: Settings, request: Request, clock: Clock, tell: Tell) -> None:
        self.settings, self.request, self.clock, self.tell = settings, request, clock, tell
        self.engine = _or_refuse(lambda: _engine(settings))
        self.at = _or_refuse(lambda: _revision(self.engine))
        self.to = downgrades.OLDEST if request.back else NEWEST
        self._path = settings.data_dir / STATE
        state = places.read_state(self._path)
        self.state = state if state.get("to") == self.to else {"from": self.at, "to": self.to}

    def all_steps(self) -> dict[str, Any]:
        """Copy, database, check."""
        done = {"from": self.state["from"], "to": self.to, "dry_run": False}
        if self.at == self.to and "copy" not in self.state:
            return done | {"copy": None, "told": [], "doubts": []}
        if self.at != self.to:
            self._copy()
            self._note(told=self.change_database())
        doubts = self._check()
        self._path.unlink(missing_ok=True)
        return done | {"copy": self.state["copy"], "told": self.state.get("told", []), "doubts": doubts}

    def _note(self, **news: Any) -> None:
        self.state |= news
        with whole_file(self._path, mode=0o600) as file:
            file.write(json.dumps(self.state).encode())

    def _copy(self) -> None:
        """The copy of this run, unless it was made before the run was cut short."""
        self.tell(0.0, "a copy of the database")
        source = database.sqlite_file(make_url(self.settings.database))
        if source is None:
            if not self.request.copied:
                raise UpgradeError("make a backup first (pg_dump --format=custom), then say so with --copied")
            return self._note(copy=None, sha256=None)
        kept = self.state.get("copy")
        if kept and Path(kept).is_file() and sha256_of(Path(kept)) == self.state.get("sha256"):
            return None
        to = copies.free_name(source.parent / BEFORE, f"{source.stem}-{self.at}")
        digest = _or_refuse(lambda: copies.copy_database(source, to))
        return self._note(copy=str(to), sha256=digest)

    def change_database(self) -> list[str]:
        """All revisions in one transaction, with an entry in the audit trail; what was set aside, a line each."""
        self.tell(0.1, f"the database, from {self.at} to {self.to}")
        return _or_refuse(self._change)

    def _change(self) -> list[str]:
        if self.at == self.to:
            return []
        with self.engine.execution_options(**WRITES).begin() as connection:
            before = _counted(connection)
            if self.request.back:
                told = downgrades.bring_down(connection, self.clock.utc())
            else:
                told = migrations.upgrade(connection)
            after = _counted(connection)
            lost = [name for name, count in before.items() if after.get(name, count) != count]
            if lost:  # an error of ours: better no upgrade than one row less
                raise migrations.SchemaError(f"{lost[0]} would have {after[lost[0]]} rows, not {before[lost[0]]}")
            with Session(connection) as session:
                audit.write(session, self.clock.utc(), WHO, "upgrade", f"{self.at} to {self.to}", told=told)
                session.flush()
        return told

    def _check(self) -> list[str]:
        """Whether the audit trail is whole, and each recording what the database says; a line for each doubt."""
        with Session(self.engine) as session:
            entries = list(session.scalars(sa.select(AuditEntry).order_by(AuditEntry.seq)))
            columns = (Recording.id, Recording.path, Recording.file_sha256)
            kept = sa.select(*columns).where(Recording.path != "")  # of the others a rule of retention took the file
            recordings = session.execute(kept.order_by(Recording.id)).all()
        broken = audit.first_broken(entries)
        doubts = [] if broken is None else [f"audit trail: entry {broken} does not fit; see stimrig audit verify"]
        for number, (name, path, digest) in enumerate(recordings):
            self.tell(0.2 + 0.8 * number / len(recordings), f"recording {number + 1} of {len(recordings)}")
            if doubt := _doubt(self._place(Path(path)), digest):
                doubts.append(f"recording {name}: {path} {doubt}; restore it from a backup")
        return doubts

    def _place(self, path: Path) -> Path:
        """The rig's own place of a file that the service's unit sees in another one (its bind mount)."""
        there = (self.request.rig_data or path.parent) / "recordings" / path.name
        return there if there.is_file() and not path.is_file() else path


def _doubt(path: Path, digest: str) -> str:
    try:
        return "" if sha256_of(path) == digest else "differs from what the database says"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _engine(settings: Settings) -> Engine:
    """To the database, without making or upgrading its tables; nobody else is connected to it."""
    url = make_url(settings.database)
    path = database.sqlite_file(url)
    if path is not None and not path.is_file():
        raise UpgradeError(f"{path}: there is no database; give the data folder with --data")
    engine = database.open_engine(url)
    if path is None:
        with engine.connect() as connection:
            mine = "datname = current_database() AND pid <> pg_backend_pid()"
            others = connection.execute(sa.text(f"SELECT COUNT(*) FROM pg_stat_activity WHERE {mine}")).scalar()
        if others:
            raise UpgradeError(f"{others} others are connected to the database; stop every service that uses it")
    return engine


def _revision(engine: Engine) -> str | None:
    with engine.connect() as connection:
        return migrations.found_revision(connection)


def _counted(connection: Connection) -> dict[str, int]:
    """Rows of each table that both schemas have."""
    names = set(sa.inspect(connection).get_table_names()) - {"alembic_version", "schema_version", "set_aside"}
    count = sa.func.count()
    return {
        name: connection.execute(sa.select(count).select_from(sa.table(name))).scalar_one() for name in sorted(names)
    }


def _or_refuse(work: Callable[[], Any]) -> Any:
    try:
        return work()
    except migrations.SchemaError as error:
        raise UpgradeError(f"the database: {error}") from error
    except (SQLAlchemyError, OSError, ImportError) as error:
        raise UpgradeError(f"the database: {' '.join(str(error).split())[:300]}; nothing was changed") from error
