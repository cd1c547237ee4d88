"""The lock of the one service of a data folder: a second start is refused with one clear line.

The folder is locked by `flock`, and that of the database, too, where a link leads to it: the kernel releases the lock
when the last process that holds it ends, and removing a file in the folder releases nothing.
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

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.settings import Settings

log = logging.getLogger("stimrig.store")
KEEP_S = 5.0
"""Interval at which the service checks that the locked folder is still in its place."""
INHERITED = "STIMRIG_FOLDER_LOCK"
"""Environment variable with the descriptor of the folder's lock, which the supervisor passes to what it starts."""
HOLDER = "service.lock"
"""File in a locked folder that says who holds it."""
OWN_FOLDER = "set STIMRIG_DATA_DIR to a folder on a local disk that this user may write"
ANOTHER = "stop it, or take another folder: --data, STIMRIG_DATA_DIR"


class HeldError(OSError):
    """The data folder is locked by another service, or cannot be locked; one line with the fix."""


class ServiceLock:
    """Locks the data folder of the settings.

    Raises HeldError: another service holds it, or it cannot be locked.
    """

    def __init__(self, settings: Settings) -> None:
        self._folders: dict[Path, int] = {}
        self._since_utc = Clock().utc()
        database = settings.database.resolve()
        try:
            if database.exists() and (names := database.stat().st_nlink) > 1:
                raise HeldError(f"{database}: the file has {names} names (hard links), SQLite needs one; keep one")
            for folder in dict.fromkeys([settings.data_dir.resolve(), database.parent]):
                self._folders[folder] = _lock_folder(folder)
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
        """End this process where another folder was put in the place of a locked one: another service may lock that."""
        for folder, descriptor in self._folders.items():
            if not folder.exists() or not os.path.samestat(os.fstat(descriptor), folder.stat()):
                log.critical("this service ends: %s was moved or replaced while it ran on it; start it anew", folder)
                os.kill(os.getpid(), signal.SIGTERM)

    def release(self) -> None:
        """Release all locks."""
        while self._folders:
            os.close(self._folders.popitem()[1])


def reserve(settings: Settings) -> int:
    """Lock the data folder before devices are started; the descriptor to pass on, which the caller closes.

    Raises HeldError: another service holds it.
    """
    lock = ServiceLock(settings)
    folder = os.dup(lock._folders[settings.data_dir.resolve()])
    lock.release()
    return folder


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
