"""What backup and restore share: the manifest, files that are copied and brought to the disk, progress."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
DATABASE = "api/stimrig.db"
MARGIN_BYTES = 64 * 2**20


class BackupError(Exception):
    """What is wrong, where, and how to fix it; `code` is the exit code."""

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = code


class Meter:
    """How much of the bytes to be read and written is done; `tell` takes the share, 0 to 1, and a line of text."""

    def __init__(self, tell: Callable[[float, str], None], of_bytes: int) -> None:
        self._tell, self._of, self._done = tell, max(of_bytes, 1), 0

    def add(self, path: Path, does: str) -> None:
        """A file is about to be read or written."""
        self._tell(min(self._done / self._of, 1.0), f"{does} {path.name}")
        self._done += path.stat().st_size if path.is_file() else 0


NO_METER = Meter(lambda _share, _text: None, 1)


def refuse_no_room(folder: Path, need_bytes: int, fix: str, code: int = 1) -> None:
    """Raise BackupError where that much does not fit."""
    free, need = shutil.disk_usage(folder).free, need_bytes + MARGIN_BYTES
    if free < need:
        raise BackupError(f"{folder}: {free // 2**20} MB free, {need // 2**20} MB needed; {fix}", code)


def size_of(folder: Path) -> int:
    """Bytes of all files in it."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def row_counts(database: Path) -> dict[str, int]:
    """How many rows each table has."""
    with closing(read_only(database)) as opened:
        names = [
            name for (name,) in opened.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        ]
        return {name: opened.execute(f'SELECT count(*) FROM "{name}"').fetchone()[0] for name in names}


def manifest(backup: Path) -> dict[str, Any]:
    """What a backup says of itself: `sha256` by file, `created_utc`, and `rows` by table where it is new enough.

    Raises BackupError: it is none, or cannot be read.
    """
    try:
        content = json.loads((backup / MANIFEST).read_text("utf-8"))
        sums = {str(name): str(digest) for name, digest in content["sha256"].items()}
        rows = {str(name): int(count) for name, count in content.get("rows", {}).items()}
    except FileNotFoundError:
        raise BackupError(f"{backup}: no {MANIFEST}; not a backup, or one that was cut short", 2) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BackupError(f"{backup / MANIFEST}: cannot be read ({error})") from None
    if content.get("format") != 1 or DATABASE not in sums:
        raise BackupError(f"{backup / MANIFEST}: not a backup of this format")
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in sums):
        raise BackupError(f"{backup / MANIFEST}: names a file outside the backup")
    return {"created_utc": str(content.get("created_utc", "")), "sha256": sums, "rows": rows}


def read_only(path: Path) -> sqlite3.Connection:
    """A database that is not changed."""
    try:
        return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10)
    except sqlite3.Error as error:
        raise BackupError(f"{path}: {error}") from None


def copy(source: Path, target: Path) -> None:
    """Copy a file to the disk; a journal that was sealed meanwhile is passed over."""
    target.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
    try:
        with source.open("rb") as old, target.open("xb") as new:
            shutil.copyfileobj(old, new, 2**20)
            new.flush()
            os.fsync(new.fileno())
    except FileNotFoundError:
        if source.suffix != ".journal":  # one that was sealed meanwhile: its recording follows
            raise
        return
    target.chmod(0o640)


def write(path: Path, data: bytes) -> None:
    """Write a file to the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    path.chmod(0o640)
