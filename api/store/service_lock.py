"""The lock of the one service of a data folder and a database: a second start is refused with one clear line.

The data folder itself, a file in it, and a file beside a SQLite database are locked by `flock`: the kernel releases a
lock when the last process that holds it ends. The lock of the folder holds although lock files are removed. A
PostgreSQL database is locked by an advisory lock that a connection of its own holds: the server releases it when the
connection ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

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
"""Interval at which the service checks that it still holds its lock files and the advisory lock."""
INHERITED = "STIMRIG_FOLDER_LOCK"
"""Environment variable with the descriptor of the folder's lock, which the supervisor passes to what it starts."""
OTHER_FOLDER = "stop it, or take another folder: --data, STIMRIG_DATA_DIR"
OTHER_DATABASE = "stop it, or take another database: STIMRIG_DATABASE_URL"


class HeldError(OSError):
    """The data folder or the database is locked by another service, or cannot be locked; one line with the fix."""


class ServiceLock:
    """Locks the data folder and the database of the settings.

    Raises HeldError: another service holds one of them, or it cannot be locked.
    """

    def __init__(self, settings: Settings) -> None:
        self._folder: int | None = None
        self._files: dict[Path, IO[str]] = {}
        self._address = "an address not known yet"
        self._database: DatabaseLock | None = None
        self._since_utc = Clock().utc()
        try:
            self._folder = _lock_folder(owner_only.folder(settings.data_dir))
            for place, locked, fix in _lock_places(settings):
                self._files[place] = _take_file(place, locked, fix)
            if settings.database.startswith("postgresql"):
                self._database = DatabaseLock(make_url(settings.database))
        except BaseException:
            self.release()
            raise
        self.write_holder(self._address)

    def write_holder(self, address: str) -> None:
        """Write this process into the lock files, for the message of a second start."""
        self._address = address
        words = {"pid": os.getpid(), "host": socket.gethostname(), "since_utc": self._since_utc, "address": address}
        for file in self._files.values():
            file.seek(0)
            file.truncate()
            file.write(json.dumps(words) + "\n")
            file.flush()

    def renew(self) -> None:
        """Take again what was lost: a lock file that was removed, or PostgreSQL's connection; call it every `KEEP_S`.

        Ends this process where another service has taken it meanwhile.
        """
        try:
            for place, file in self._files.items():
                if not (place.exists() and os.path.samestat(place.stat(), os.fstat(file.fileno()))):
                    log.warning("%s was removed while this service runs on it; it is locked anew", place)
                    self._files[place] = _take_file(place, place, "do not remove lock files")
                    file.close()
                    self.write_holder(self._address)
            if self._database is not None:
                self._database.acquire()
        except HeldError as error:
            log.critical("this service ends: %s", error)
            os.kill(os.getpid(), signal.SIGTERM)
        except (SQLAlchemyError, OSError) as error:  # it is looked at again after `KEEP_S`
            log.warning("whether the lock is still held cannot be seen: %s", error)

    def release(self) -> None:
        """Release all locks."""
        while self._files:
            self._files.popitem()[1].close()
        if self._database is not None:
            self._database.release()
        if self._folder is not None:
            os.close(self._folder)
            self._folder = None

    def release_all_but_folder(self) -> int | None:
        """Release the rest; the descriptor that holds the folder's lock, which is the caller's to close from now on."""
        folder, self._folder = self._folder, None
        self.release()
        return folder


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
            raise HeldError(f"{self._safe_url}: another service runs on it; {OTHER_DATABASE}")

    def release(self) -> None:
        """End the connection, which releases the lock."""
        if self._connection is not None:
            self._connection.invalidate()
            self._connection.close()
            self._connection = None


def reserve(settings: Settings) -> int | None:
    """Lock the data folder before devices are started; the descriptor to pass on, None where folders cannot be locked.

    Raises HeldError: another service holds the folder or the database.
    """
    return ServiceLock(settings).release_all_but_folder()


def _lock_folder(folder: Path) -> int | None:
    """Lock a folder, or use the lock that the supervisor has passed on; its descriptor."""
    inherited = os.environ.get(INHERITED, "")
    with contextlib.suppress(OSError):
        if inherited and os.path.samestat(os.fstat(int(inherited)), folder.stat()):
            os.set_inheritable(int(inherited), False)
            return int(inherited)
    try:
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise HeldError(f"{folder}: {error.strerror}; set STIMRIG_DATA_DIR to a folder this user may write") from error
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(opened)
        holder = _holder(folder / "service.lock")
        raise HeldError(f"{folder}: another service runs on it: {holder}; {OTHER_FOLDER}") from None
    except OSError:  # a network's file system: the lock files alone have to do
        os.close(opened)
        return None
    return opened


def _lock_places(settings: Settings) -> Iterator[tuple[Path, Path, str]]:
    folder = owner_only.folder(settings.data_dir)
    yield folder / "service.lock", folder, OTHER_FOLDER
    try:
        url = make_url(settings.database)
    except ArgumentError:
        return  # the store says what is wrong with it
    database = sqlite_file(url)
    if database is None:  # in memory, or PostgreSQL
        return
    real = database.resolve()
    if real.exists() and real.stat().st_nlink > 1:
        raise HeldError(f"{real}: the file has {real.stat().st_nlink} names (hard links), SQLite needs one; keep one")
    owner_only.folder(real.parent)
    yield real.with_name(f"{real.name}.lock"), database, OTHER_DATABASE


def _take_file(place: Path, locked: Path, fix: str) -> IO[str]:
    try:
        file = os.fdopen(os.open(place, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+", encoding="utf-8")
    except OSError as error:
        raise HeldError(f"{place}: {error.strerror}; set STIMRIG_DATA_DIR to a folder this user may write") from error
    owner_only.close(place, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            raise HeldError(f"{locked}: another service runs on it: {_holder(place)}; {fix}") from None
    except OSError as error:
        file.close()
        raise HeldError(f"{place}: cannot be locked ({error.strerror}); take a folder on a local disk") from error
    file.truncate(0)
    return file


def _holder(place: Path) -> str:
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        holder = json.loads(place.read_text("utf-8"))
        return f"process {holder['pid']} on {holder['host']}, since {holder['since_utc']}, at {holder['address']}"
    return "it starts just now, or its lock file was removed"
