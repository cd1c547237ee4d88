"""How each kind of database is opened, and how one writer at a time has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL
from sqlalchemy.exc import ArgumentError

from stimrig.api import owner_only

WRITES = {"stimrig_writes": True}
"""Execution option of a transaction that writes."""
WRITER_KEY = 0x5354494D52494701
"""PostgreSQL's advisory lock of whoever writes: "STIMRIG" and 1."""
CONNECT_S, POOL_S = 3, 5
SERVER_SETTINGS = {
    "lock_timeout": 10_000,  # for another writer, ms
    "statement_timeout": 30_000,
    "idle_in_transaction_session_timeout": 30_000,  # a writer that was stopped in the middle lets go
    "tcp_keepalives_idle": 10,  # s; a machine that is gone lets go, too
    "tcp_keepalives_interval": 5,
    "tcp_keepalives_count": 3,
}
KEEPALIVES = {"keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3, "tcp_user_timeout": 10_000}


def opened(url: URL) -> Engine:
    """An engine for SQLite or PostgreSQL.

    Raises
    ------
    ArgumentError
        Another kind of database.
    ImportError
        The driver is not installed.
    """
    kind = url.get_backend_name()
    if kind == "sqlite":
        return _sqlite(url)
    if kind == "postgresql":
        return _postgresql(url)
    raise ArgumentError(f"{kind}: neither sqlite nor postgresql")


def _sqlite(url: URL) -> Engine:
    """WAL, every commit on the disk, for its owner only."""
    path = sqlite_file(url)
    if path is not None:
        close_to_others(path)
    engine = create_engine(url)
    event.listen(engine, "connect", _durable_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _postgresql(url: URL) -> Engine:
    """Through psycopg 3; a server that does not answer is given up within seconds."""
    options = " ".join(f"-c {name}={value}" for name, value in SERVER_SETTINGS.items())
    try:
        engine = create_engine(
            url.set(drivername="postgresql+psycopg"),
            pool_pre_ping=True, pool_size=10, max_overflow=20, pool_timeout=POOL_S,
            connect_args={"connect_timeout": CONNECT_S, "options": options, **KEEPALIVES},
        )  # fmt: skip
    except ImportError as error:
        raise ImportError("PostgreSQL needs psycopg: pip install 'stimrig[centre]'") from error
    event.listen(engine, "begin", _begin_postgresql)
    return engine


def _durable_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # `_begin_sqlite` begins transactions, not the driver
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=5000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def writes(connection: Connection) -> bool:
    """Whether a transaction of this connection writes."""
    return WRITES.items() <= connection.get_execution_options().items()


def _begin_sqlite(connection: Connection) -> None:
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes(connection) else "BEGIN")


def _begin_postgresql(connection: Connection) -> None:
    """Each statement after it sees what the writer before has committed (read committed)."""
    if writes(connection):
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({WRITER_KEY})")


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
