"""Uploaded files: in a folder of their own until the database names them, and never deleted after that.

A service that is killed in between leaves a file in that folder. The next start removes it, or moves it to its place if
the database names it already. A whole file stays, whatever the database says: it may be the wrong database.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stimrig.api.store import Store

PREFIX, JOINED = "upload-", "joined-"
PARTS = "parts"
SUFFIXES = (".csv", ".h5", ".mat", ".parquet")
MAX_LISTED = 10
log = logging.getLogger("stimrig.uploads")


def part_of(whole: Path) -> Path:
    """Return the place of a file until the database names it; the name is the same, for models and messages hold it."""
    return whole.parent / PARTS / whole.name


def whole_of(part: Path) -> Path:
    """Return the place of a file once the database names it."""
    return part.parent.parent / part.name


@contextlib.contextmanager
def taken_in(whole: Path) -> Iterator[None]:
    """Move a file to its place once its row, written within, is committed; delete it if that fails."""
    part = part_of(whole)
    try:
        yield
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    part.replace(whole)


def settle(folder: Path, store: Store) -> None:
    """Finish at the start what a killed service had begun, and log which whole files the database does not name.

    Only files that this service itself writes count, by their names.
    """
    from stimrig.api.store.tables import Recording

    named = {Path(path).name for path in store.all(Recording.path)}
    for part in _ours(folder / PARTS):
        if part.name in named and not whole_of(part).exists():
            part.replace(whole_of(part))
            log.warning("moved to its place what the database names already: %s", part.name)
        else:
            part.unlink(missing_ok=True)
            log.warning("removed what had not been taken in: %s", part.name)
    unnamed = [path.name for path in _ours(folder) if path.suffix in SUFFIXES and path.name not in named]
    if unnamed:
        more = f" and {len(unnamed) - MAX_LISTED} more" if len(unnamed) > MAX_LISTED else ""
        names = ", ".join(unnamed[:MAX_LISTED]) + more
        log.warning("the database does not name %s; nothing of it was deleted. Is it the right database?", names)


def _ours(folder: Path) -> list[Path]:
    paths = sorted(path for path in folder.iterdir() if path.name.startswith((PREFIX, JOINED)))
    return [path for path in paths if path.is_file() and not path.is_symlink()]
