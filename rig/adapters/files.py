"""The rig's files on a real disk."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from pathlib import Path

from stimrig.rig.errors import BusyError


class Files:
    """See `stimrig.rig.machine.Disk`."""

    def make_folder(self, path: Path) -> None:
        path.mkdir(parents=True, exist_ok=True)

    def lock(self, folder: Path) -> contextlib.ExitStack:
        # not a file of its own: whoever removed that would let a second rig in
        journals, holder = folder / "journals", folder / "rig.lock"
        self.make_folder(journals)
        with contextlib.ExitStack() as stack:
            fd = os.open(journals, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            stack.callback(os.close, fd)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                pid = holder.read_text().strip() if holder.is_file() else "unknown"
                raise BusyError(
                    f"data_dir {folder}: another rig (process {pid}) uses it; stop that rig first"
                ) from None
            holder.write_text(str(os.getpid()))
            return stack.pop_all()

    def create(self, path: Path) -> LogFile:
        return LogFile(path)

    def is_written(self, path: Path) -> bool:
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # reading it tells why
            return False
        return False

    def read(self, path: Path) -> bytes:
        return path.read_bytes()

    def replace(self, path: Path, data: bytes) -> None:
        temporary = None
        try:
            fd, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            with os.fdopen(fd, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).chmod(0o640)
            Path(temporary).rename(path)
            _sync_folder(path.parent)
        except OSError:
            if temporary is not None:
                Path(temporary).unlink(missing_ok=True)
            raise

    def rename(self, path: Path, to: Path) -> None:
        path.rename(to)

    def remove(self, path: Path) -> None:
        path.unlink(missing_ok=True)

    def names(self, folder: Path) -> list[str]:
        with contextlib.suppress(OSError):
            return sorted(path.name for path in folder.iterdir())
        return []

    def free_bytes(self, folder: Path) -> int:
        status = os.statvfs(folder)
        return status.f_bavail * status.f_frsize


class LogFile:
    """See `rig.machine.Log`. It is locked while it is open, so that nobody seals it while it is still being written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o640)
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _sync_folder(path.parent)

    def append(self, data: bytes) -> None:
        if os.write(self._fd, data) != len(data):
            raise OSError(28, "disk full: block cut short")

    def sync(self) -> None:
        os.fdatasync(self._fd)

    def close(self) -> None:
        try:
            self.sync()
        finally:
            os.close(self._fd)


def _sync_folder(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
