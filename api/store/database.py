"""The database: SQLite by default, or PostgreSQL.

One transaction writes at a time, so what it has read stays true until it is committed.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sqlalchemy import Connection, Engine, create_engine, event, select
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DatabaseError, OperationalError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.store import audit, migrations
from stimrig.api.store.tables import Secret

WRITES = "stimrig_writes"
"""Execution option of the connections that write."""
OTHER_WRITER_MS = 10_000
"""Timeout for another process's lock."""
POSTGRESQL = {
    "lock_timeout": OTHER_WRITER_MS,
    "statement_timeout": 30_000,
    "idle_in_transaction_session_timeout": 30_000,  # a writer that was stopped in the middle lets go
    "tcp_keepalives_idle": 10,  # s; a machine that is gone lets go, too
    "tcp_keepalives_interval": 5,
    "tcp_keepalives_count": 3,
}
KEEPALIVES = {"keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3, "tcp_user_timeout": 10_000}


class Store:
    """The database, opened and its tables made.

    `url`: SQLAlchemy URL. Raises ApiError: the URL cannot be read or the database not opened.
    """

    def __init__(self, url: str) -> None:
        safe_url = url
        try:
            parsed = make_url(url)
            safe_url = parsed.render_as_string(hide_password=True)
            self.engine = open_engine(parsed)
            migrations.migrate(self.engine)
        except migrations.SchemaError as error:
            raise ApiError(503, "database", "The database has another version", str(error)) from error
        except (ArgumentError, SQLAlchemyError, ImportError, OSError) as error:
            raise ApiError(503, "database", "The database cannot be opened", why_not_opened(error, safe_url)) from error
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)
        self._writing = sessionmaker(self.engine.execution_options(**{WRITES: True}), expire_on_commit=False)
        self._write_lock = threading.Lock()

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session for reading."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction: committed at the end, rolled back at an error. One at a time."""
        with self._write_lock, self._writing.begin() as session:
            yield session

    def get(self, table: type[Any], key: Any) -> Any:
        """Return a row by its key, or None."""
        with self.read() as session:
            return session.get(table, key)

    def all(self, table: Any, *where: Any, order: Any = None, limit: int | None = None) -> list[Any]:
        """Rows, or one column of them, that hold the conditions, in order."""
        with self.read() as session:
            return list(session.scalars(select(table).where(*where).order_by(order).limit(limit)))

    def first(self, table: Any, *where: Any, order: Any = None) -> Any:
        """The first of these, or None."""
        return next(iter(self.all(table, *where, order=order, limit=1)), None)

    def note(self, clock: Clock, actor: str, action: str, subject: str, **detail: Any) -> None:
        """Append an entry to the audit trail in a transaction of its own."""
        with self.write() as session:
            audit.write(session, clock.utc(), actor, action, subject, **detail)

    def compact(self) -> None:
        """Write a SQLite file anew, so that deleted rows are not left in it; PostgreSQL's autovacuum does that."""
        if self.engine.dialect.name == "sqlite":
            with closing(self.engine.raw_connection()) as connection:  # without the transaction of a session
                for statement in ("VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"):
                    connection.cursor().execute(statement)

    def secret(self, name: str) -> bytes:
        """The secret of this name: 32 bytes, drawn once, so that pages stay good over a restart."""
        with self.write() as session:
            row = session.get(Secret, name)
            if row is None:
                row = Secret(name=name, value=secrets.token_bytes(32))
                session.add(row)
        return row.value

    def close(self) -> None:
        """Close the connections."""
        self.engine.dispose()


def why_not_opened(error: Exception, safe_url: str) -> str:
    """Say in one line what is wrong with the database, and the fix."""
    first = str(error).splitlines()[0]
    if safe_url.startswith("postgresql"):
        return f"{safe_url}: {first}; see that it runs and that STIMRIG_DATABASE_URL names it (docs/install.md)"
    fix = "set STIMRIG_DATABASE_URL or STIMRIG_DATA_DIR to a place this user may write"
    if isinstance(error, DatabaseError) and not isinstance(error, OperationalError):
        fix = "restore the database from a backup, or set STIMRIG_DATA_DIR to another folder"
    return f"{first}; {fix}"


def open_engine(url: URL) -> Engine:
    """An engine for SQLite (WAL, every commit on the disk, for its owner only) or PostgreSQL (through psycopg 3).

    An error's words go to the log: parameters, which may be a code, stay out of them.

    Raises ArgumentError: another kind of database. ImportError: the driver is not installed.
    """
    kind = url.get_backend_name()
    if kind == "sqlite":
        if (path := sqlite_file(url)) is not None:
            close_to_others(path)
        engine = create_engine(url, hide_parameters=True)
        event.listen(engine, "connect", _durable_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if kind != "postgresql":
        raise ArgumentError(f"{kind}: neither sqlite nor postgresql")
    options = " ".join(f"-c {name}={value}" for name, value in POSTGRESQL.items())
    try:
        return create_engine(
            url.set(drivername="postgresql+psycopg"), hide_parameters=True,
            pool_pre_ping=True, pool_size=10, max_overflow=20, pool_timeout=5,
            connect_args={"connect_timeout": 3, "options": options, **KEEPALIVES},
        )  # fmt: skip
    except ImportError as error:
        raise ImportError("PostgreSQL needs psycopg: pip install 'stimrig[postgresql]'") from error


def _durable_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the event `begin` begins transactions, not the driver
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"busy_timeout={OTHER_WRITER_MS}"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads and then writes never waits for another process's lock: it fails at once.
    writes = connection.get_execution_options().get(WRITES, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def sqlite_file(url: URL) -> Path | None:
    """The file behind a URL; None where there is none."""
    name = url.database or ""
    if url.get_backend_name() != "sqlite" or name in ("", ":memory:") or "mode=memory" in name:
        return None
    return Path(unquote(urlsplit(name).path)) if name.startswith("file:") else Path(name)


def close_to_others(path: Path) -> None:
    """The database is for its owner only: SQLite gives what it makes beside it the same rights."""
    owner_only.folder(path.parent)
    owner_only.file(path)
    for suffix in ("-wal", "-shm", "-journal"):
        owner_only.close(path.with_name(path.name + suffix), 0o600)
