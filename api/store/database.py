"""One door to the database: SQLite (WAL, every commit on the disk), for its owner only."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sqlalchemy import create_engine, event, select
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DatabaseError, OperationalError
from sqlalchemy.orm import Session, sessionmaker

from api import owner_only
from api.errors import ApiError
from api.store import migrations


class Store:
    """The database, opened and its tables made.

    Parameters
    ----------
    url : str
        SQLAlchemy URL.

    Raises
    ------
    ApiError
        The URL cannot be read or the database not opened.
    """

    def __init__(self, url: str) -> None:
        try:
            parsed = make_url(url)
            path = sqlite_file(parsed)
            if path is not None:
                close_to_others(path)
            self.engine = create_engine(parsed)
            if parsed.get_backend_name() == "sqlite":
                event.listen(self.engine, "connect", _durable_sqlite)
            migrations.bring_up(self.engine)
        except migrations.SchemaError as error:
            raise ApiError(503, "database", "The database has another version", str(error)) from error
        except (ArgumentError, DatabaseError, ImportError, OSError) as error:
            fix = "set STIMRIG_DATABASE_URL or STIMRIG_DATA_DIR to a place this user may write"
            if isinstance(error, DatabaseError) and not isinstance(error, OperationalError):
                fix = "restore the database from a backup, or set STIMRIG_DATA_DIR to another folder"
            raise ApiError(503, "database", "The database cannot be opened", f"{_first_line(error)}; {fix}") from error
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)
        self.write_lock = threading.RLock()

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session for reading."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction: committed at the end, rolled back at an error. One writer at a time."""
        with self.write_lock, self._sessions.begin() as session:
            yield session

    def get(self, table: type[Any], key: Any) -> Any:
        """One row by its key, or None."""
        with self.read() as session:
            return session.get(table, key)

    def all(self, table: Any, *where: Any, order: Any = None, limit: int | None = None) -> list[Any]:
        """Rows that hold the conditions, in order."""
        query = select(table).where(*where)
        if order is not None:
            query = query.order_by(order)
        if limit is not None:
            query = query.limit(limit)
        with self.read() as session:
            return list(session.scalars(query))

    def listen(self, event_name: str, heard: Callable[..., None]) -> None:
        """Hear an event of every session of this store, e.g. `before_commit`."""
        event.listen(self._sessions, event_name, heard)

    def close(self) -> None:
        """Let the connections go."""
        self.engine.dispose()


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
    for beside in ("-wal", "-shm", "-journal"):
        owner_only.close(path.with_name(path.name + beside), 0o600)


def _durable_sqlite(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=5000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
