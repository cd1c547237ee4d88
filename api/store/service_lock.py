"""The lock of the one service of a data folder and a database: a second start is refused with one clear line.

The data folder and the folder of a SQLite database are locked by `flock`: the kernel releases the lock when the last
process that holds it ends, and removing a file in the folder releases nothing. A PostgreSQL database is locked by an
advisory lock that a connection of its own holds: the server releases it when the connection ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import signal
import socket
from pathlib import Path

from sqlalchemy import Connection
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store.database import open_engine, sqlite_file, why_not_opened

log = logging.getLogger("stimrig.store")
SERVICE_KEY = 0x5354494D52494702
"""PostgreSQL's advisory lock of the service: "STIMRIG" and 2."""
KEEP_S = 5.0
"""Interval at which the service checks that it still holds the advisory lock."""
INHERITED = "STIMRIG_FOLDER_LOCK"
"""Environment variable with the descriptor of the folder's lock, which the supervisor passes to what it starts."""
HOLDER = "service.lock"
"""File in a locked folder that says who holds it."""
OWN_FOLDER = "set STIMRIG_DATA_DIR to a folder on a local disk that this user may write"
ANOTHER = "stop it, or take another folder or database: --data, STIMRIG_DATA_DIR, STIMRIG_DATABASE_URL"


class HeldError(OSError):
    """The data folder or the database is locked by another service, or cannot be locked; one line with the fix."""


class ServiceLock:
    """Locks the data folder and the database of the settings.

    Raises HeldError: another service holds one of them, or it cannot be locked.
    """

    def __init__(self, settings: Settings) -> None:
        self._folders: dict[Path, int] = {}
        self._database: DatabaseLock | None = None
        self._since_utc = Clock().utc()
        try:
            for folder in dict.fromkeys([settings.data_dir.resolve(), *_database_folder(settings)]):
                self._folders[folder] = _lock_folder(folder)
            if settings.database.startswith("postgresql"):
                self._database = DatabaseLock(make_url(settings.database))
            self.write_holder("an address not known yet")
        except BaseException:
            self.release()
            raise

    def write_holder(self, address: str) -> None:
        """Write this process into the locked folders, for the message of a second start."""
        words = {"pid": os.getpid(), "host": socket.gethostname(), "since_utc": self._since_utc, "address": address}
        for folder in self._folders:
            try:
                owner_only.file(folder / HOLDER)
                (folder / HOLDER).write_text(json.dumps(words) + "\n", "utf-8")
            except OSError as error:
                raise HeldError(f"{folder / HOLDER}: {error.strerror}; {OWN_FOLDER}") from error

    def renew(self) -> None:
        """Take PostgreSQL's lock again where its connection was lost; call it every `KEEP_S`.

        Ends this process where another service may have a lock meanwhile: of the database, or of a folder that was put
        in the place of the locked one.
        """
        try:
            for folder, descriptor in self._folders.items():
                if not folder.exists() or not os.path.samestat(os.fstat(descriptor), folder.stat()):
                    raise HeldError(f"{folder}: it was moved or replaced while this service ran on it; start it anew")
            if self._database is not None:
                self._database.acquire()
        except HeldError as error:
            log.critical("this service ends: %s", error)
            os.kill(os.getpid(), signal.SIGTERM)
        except SQLAlchemyError as error:  # it is looked at again after `KEEP_S`
            log.warning("whether the lock is still held cannot be seen: %s", error)

    def release(self) -> None:
        """Release all locks."""
        while self._folders:
            os.close(self._folders.popitem()[1])
        if self._database is not None:
            self._database.release()


class DatabaseLock:
    """The advisory lock of a PostgreSQL database. Raises HeldError: another service has it, or no connection."""

    def __init__(self, url: URL) -> None:
        self._safe_url = url.render_as_string(hide_password=True)
        self._connection: Connection | None = None
        try:
            self._engine = open_engine(url).execution_options(isolation_level="AUTOCOMMIT")
            self.acquire()
        except (SQLAlchemyError, ImportError) as error:
            raise HeldError(why_not_opened(error, self._safe_url)) from error

    def acquire(self) -> None:
        """Take it unless this connection has it. Raises HeldError, SQLAlchemyError."""
        if self._connection is not None:
            try:
                self._connection.exec_driver_sql("SELECT 1")
                return
            except SQLAlchemyError:
                self.release()
        self._connection = self._engine.connect()
        if not self._connection.exec_driver_sql(f"SELECT pg_try_advisory_lock({SERVICE_KEY})").scalar():
            self.release()
            raise HeldError(f"{self._safe_url}: another service runs on it; {ANOTHER}")

    def release(self) -> None:
        """Release the lock and end the connection; the server would release it a moment after the end."""
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                self._connection.exec_driver_sql(f"SELECT pg_advisory_unlock({SERVICE_KEY})")
            self._connection.invalidate()
            self._connection.close()
            self._connection = None


def reserve(settings: Settings) -> int:
    """Lock the data folder before devices are started; the descriptor to pass on, which the caller closes.

    Raises HeldError: another service holds the folder or the database.
    """
    lock = ServiceLock(settings)
    folder = os.dup(lock._folders[settings.data_dir.resolve()])
    lock.release()
    return folder


def _database_folder(settings: Settings) -> list[Path]:
    """The folder of a SQLite database; none of one in memory, of PostgreSQL, or of a URL that the store refuses."""
    try:
        path = sqlite_file(make_url(settings.database))
    except ArgumentError:
        return []
    if path is None:
        return []
    real = path.resolve()
    if real.exists() and real.stat().st_nlink > 1:
        raise HeldError(f"{real}: the file has {real.stat().st_nlink} names (hard links), SQLite needs one; keep one")
    return [real.parent]


def _lock_folder(folder: Path) -> int:
    """Lock a folder, or use the lock that the supervisor has passed on; its descriptor."""
    try:
        owner_only.folder(folder)
        inherited = os.environ.get(INHERITED, "")
        with contextlib.suppress(OSError):
            if inherited and os.path.samestat(os.fstat(int(inherited)), folder.stat()):
                os.set_inheritable(int(inherited), False)
                return int(inherited)
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise HeldError(f"{folder}: {error.strerror}; {OWN_FOLDER}") from error
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(opened)
        if isinstance(error, BlockingIOError):
            raise HeldError(f"{folder}: another service runs on it: {_holder(folder / HOLDER)}; {ANOTHER}") from None
        raise HeldError(f"{folder}: cannot be locked ({error.strerror}); {OWN_FOLDER}") from error
    return opened


def _holder(place: Path) -> str:
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        holder = json.loads(place.read_text("utf-8"))
        return f"process {holder['pid']} on {holder['host']}, since {holder['since_utc']}, at {holder['address']}"
    return "it starts just now, or its lock file was removed"
