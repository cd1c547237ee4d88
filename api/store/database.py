"""One door to the database: SQLite by default, or PostgreSQL.

Who writes has the database alone, whichever process it is in: what a transaction reads holds until it is committed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import event, select
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DatabaseError, OperationalError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from stimrig.api.clock import Clock, local_day
from stimrig.api.errors import ApiError
from stimrig.api.store import engines, migrations
from stimrig.api.store.seen import About, Seen, check, newest


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
        shown = url
        try:
            parsed = make_url(url)
            shown = parsed.render_as_string(hide_password=True)
            self.engine = engines.opened(parsed)
            migrations.bring_up(self.engine)
        except migrations.SchemaError as error:
            raise ApiError(503, "database", "The database has another version", str(error)) from error
        except (ArgumentError, SQLAlchemyError, ImportError, OSError) as error:
            raise ApiError(503, "database", "The database cannot be opened", _why(error, shown)) from error
        self.several = parsed.get_backend_name() != "sqlite"
        """Whether other services may use it at the same time."""
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)
        self._writing = sessionmaker(self.engine.execution_options(**engines.WRITES), expire_on_commit=False)
        self._write_lock = threading.Lock()

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session for reading."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction: committed at the end, rolled back at an error. One writer at a time, of all processes."""
        with self._write_lock, self._writing.begin() as session:
            session.connection()  # begins it now: before anything is read
            yield session

    def get(self, table: type[Any], key: Any) -> Any:
        """One row by its key, or None."""
        with self.read() as session:
            return session.get(table, key)

    def all(self, table: Any, *where: Any, order: Any = None, limit: int | None = None) -> list[Any]:
        """Rows, or one column of them, that hold the conditions, in order."""
        query = select(table).where(*where)
        if order is not None:
            query = query.order_by(order)
        if limit is not None:
            query = query.limit(limit)
        with self.read() as session:
            return list(session.scalars(query))

    def seen(self, clock: Clock, *about: About) -> Seen:
        """The version of what rests on these entries of the audit trail; without `about`, on any."""
        with self.read() as session:
            return newest(session, local_day(clock.utc()), *about)

    def etag(self, clock: Clock, document: str, *about: About) -> str:
        """The same, as HTTP has it for the document at this path."""
        return self.seen(clock, *about).etag(document)

    def refuse_changed(self, *about: About) -> None:
        """Refuse to ask a question about what has changed since the page was shown. Raises ChangedError."""
        with self.read() as session:
            check(session, *about)

    def listen(self, event_name: str, heard: Callable[..., None]) -> None:
        """Hear an event of every session that writes, e.g. `before_commit`."""
        event.listen(self._writing, event_name, heard)

    def close(self) -> None:
        """Let the connections go."""
        self.engine.dispose()


def _why(error: Exception, shown: str) -> str:
    """What is wrong with the database, and the fix, in one line."""
    first = str(error).splitlines()[0]
    if shown.startswith("postgresql"):
        return f"{shown}: {first}; see that it runs and that STIMRIG_DATABASE_URL names it (docs/install.md)"
    fix = "set STIMRIG_DATABASE_URL or STIMRIG_DATA_DIR to a place this user may write"
    if isinstance(error, DatabaseError) and not isinstance(error, OperationalError):
        fix = "restore the database from a backup, or set STIMRIG_DATA_DIR to another folder"
    return f"{first}; {fix}"
