"""One service on a data folder and on a SQLite database: whoever comes second is told who holds it.

Held by `flock` on two files: one in the data folder, one beside the database's own file, so that two folders that name
one database are found, too, through whatever links. The kernel lets go when the process ends, however it ends.
Several services may share a PostgreSQL database, each with a data folder of its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store.engines import sqlite_file


class HeldError(OSError):
    """Another service holds the place, or it cannot be held; one line with the fix."""


class ServiceLock:
    """What this service holds.

    Parameters
    ----------
    settings : Settings
        Data folder and database.

    Raises
    ------
    HeldError
        Another service holds one of them.
    """

    def __init__(self, settings: Settings) -> None:
        self._files: list[IO[str]] = []
        self._since_utc = Clock().utc()
        try:
            for place, shown, fix in _places(settings):
                self._files.append(_held(place, shown, fix))
        except BaseException:
            self.release()
            raise
        self.tell("an address not known yet")

    def tell(self, address: str) -> None:
        """Write down who holds it, for whoever comes second."""
        words = {"pid": os.getpid(), "host": socket.gethostname(), "since_utc": self._since_utc, "address": address}
        for file in self._files:
            file.seek(0)
            file.truncate()
            file.write(json.dumps(words) + "\n")
            file.flush()

    def release(self) -> None:
        """Let go."""
        while self._files:
            self._files.pop().close()


def refuse_if_held(settings: Settings) -> None:
    """Say at once, before devices are started, that another service holds the place. Raises HeldError."""
    ServiceLock(settings).release()


def _places(settings: Settings) -> Iterator[tuple[Path, Path, str]]:
    folder = owner_only.folder(settings.data_dir)
    yield folder / "service.lock", folder, "stop it, or take another folder: --data, STIMRIG_DATA_DIR"
    try:
        url = make_url(settings.database)
    except ArgumentError:
        return  # the store says what is wrong with it
    database = sqlite_file(url)
    if database is None:  # in memory: nobody else's; PostgreSQL: made for several
        return
    real = database.resolve()
    if real.exists() and real.stat().st_nlink > 1:
        raise HeldError(f"{real}: the file has {real.stat().st_nlink} names (hard links), SQLite needs one; keep one")
    owner_only.folder(real.parent)
    yield real.with_name(f"{real.name}.lock"), database, "stop it, or take another database: STIMRIG_DATABASE_URL"


def _held(place: Path, shown: Path, fix: str) -> IO[str]:
    try:
        file = os.fdopen(os.open(place, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+", encoding="utf-8")
    except OSError as error:
        raise HeldError(f"{place}: {error.strerror}; set STIMRIG_DATA_DIR to a folder this user may write") from error
    owner_only.close(place, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            raise HeldError(f"{shown}: another service runs on it: {_who(file)}; {fix}") from None
    except OSError as error:
        file.close()
        raise HeldError(f"{place}: cannot be locked ({error.strerror}); take a folder on a local disk") from error
    file.truncate(0)
    return file


def _who(file: IO[str]) -> str:
    with contextlib.suppress(ValueError, KeyError, TypeError):
        said = json.loads(file.read())
        return f"process {said['pid']} on {said['host']}, since {said['since_utc']}, at {said['address']}"
    return "it starts just now"
