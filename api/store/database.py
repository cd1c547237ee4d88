"""The database: SQLite in the data folder.

One transaction writes at a time, so what it has read stays true until it is committed.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, create_engine, event, select
from sqlalchemy.exc import DatabaseError, OperationalError, SQLAlchemyError
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


class Store:
    """The database, opened and its tables made: for its owner only, every commit on the disk.

    Raises ApiError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        # an error's words go to the log: parameters, which may be a code, stay out of them
        self.engine = create_engine(URL.create("sqlite", database=str(path)), hide_parameters=True)
        event.listen(self.engine, "connect", _durable_sqlite)
        event.listen(self.engine, "begin", _begin_sqlite)
        try:
            owner_only.folder(path.parent)
            owner_only.file(path)  # SQLite gives what it makes beside it the same rights
            for suffix in ("-wal", "-shm", "-journal"):
                owner_only.close(path.with_name(path.name + suffix), 0o600)
            migrations.migrate(self.engine, path)
        except migrations.SchemaError as error:
            raise ApiError(503, "database", "The database has another version", str(error)) from error
        except (SQLAlchemyError, OSError) as error:
            damaged = isinstance(error, DatabaseError) and not isinstance(error, OperationalError)
            way_out = "restore the database from a backup, or set" if damaged else "set"
            where = "another folder" if damaged else "a place that this user may write"
            detail = f"{path}: {str(error).splitlines()[0]}; {way_out} STIMRIG_DATA_DIR to {where}"
            raise ApiError(503, "database", "The database cannot be opened", detail) from error
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
        """Write the file anew, so that deleted rows are not left in it."""
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


def _durable_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the event `begin` begins transactions, not the driver
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"busy_timeout={OTHER_WRITER_MS}"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads and then writes never waits for another process's lock: it fails at once.
    writes = connection.get_execution_options().get(WRITES, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
