"""The files that items name: found by their SHA-256, looked through before they are sent, read piece by piece."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import select

from api.store import Store
from api.store.tables import Model, OutboxItem, Recording, Tracked

PIECE = 65536
MOST_COPIES = 20
MOST_UNKNOWN = 1000
"""Files that a centre asks for and no item names are remembered up to so many: as many as it may ask for at once."""
Signature = tuple[int, int, int]


@dataclass(frozen=True)
class Source:
    """A file to be sent: on the disk, or a document of the database."""

    sha256: str
    path: Path | None
    document: bytes | None
    size: int

    def pieces(self, offset: int, length: int) -> Iterator[bytes]:
        """Its bytes from a place on; fewer than `length` where it was cut meanwhile."""
        if self.document is not None:
            yield self.document[offset : offset + length]
            return
        assert self.path is not None
        with self.path.open("rb") as file:
            file.seek(offset)
            while length > 0 and (piece := file.read(min(PIECE, length))):
                length -= len(piece)
                yield piece


class Files:
    """Finds what is to be sent, and remembers what is damaged.

    Attributes
    ----------
    damaged : dict
        SHA-256 of each file that is missing or has another content, with what was seen of it: it is looked through
        again only once that changes.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self.damaged: dict[str, tuple[Signature | None, ...]] = {}
        self._whole: tuple[str, Path, Signature] | None = None
        self._unknown: deque[str] = deque()

    def source_known(self, sha256: str) -> bool:
        """Whether it is worth a look: not damaged, or changed since that was found."""
        return sha256 not in self.damaged or self.damaged[sha256] != _seen(self._rows(sha256))

    def source(self, sha256: str) -> Source | None:
        """A file that has this content now, or None: it is damaged."""
        rows = self._rows(sha256)
        seen = _seen(rows)
        if sha256 in self.damaged and self.damaged[sha256] == seen:
            return None
        for row in rows:
            found = self._checked(sha256, row)
            if found is not None:
                self.damaged.pop(sha256, None)
                return found
        self._note(sha256, seen)
        return None

    def _note(self, sha256: str, seen: tuple[Signature | None, ...]) -> None:
        """It is damaged; of those that the rig knows nothing of, the oldest one is forgotten where they are many."""
        self.damaged[sha256] = seen
        if not seen:
            self._unknown.append(sha256)
            if len(self._unknown) > MOST_UNKNOWN:
                self.damaged.pop(self._unknown.popleft(), None)

    def unknown(self, sha256: str) -> bool:
        """Whether it was looked for, and no item names it."""
        return self.damaged.get(sha256) == ()

    def doubt(self, sha256: str) -> None:
        """The centre got something else: look through it once more."""
        if self._whole is not None and self._whole[0] == sha256:
            self._whole = None

    def _rows(self, sha256: str) -> list[Recording | Model | Tracked]:
        """The rows whose file it is; the same file may have been taken in twice."""
        of = select(OutboxItem.kind, OutboxItem.key).where(OutboxItem.file == sha256).distinct().limit(MOST_COPIES)
        with self.store.read() as session:
            named = session.execute(of).all()
            found = [session.get(TABLES[kind], key) for kind, key in named if kind in TABLES]
        return [row for row in found if row is not None]

    def _checked(self, sha256: str, row: Recording | Model | Tracked) -> Source | None:
        if not isinstance(row, Recording):
            body = row.document or b""
            return Source(sha256, None, body, len(body)) if hashlib.sha256(body).hexdigest() == sha256 else None
        path = Path(row.path)
        seen = _signature(path)
        if seen is None:
            return None
        if self._whole != (sha256, path, seen):
            if _digest(path) != sha256 or _signature(path) != seen:
                return None
            self._whole = (sha256, path, seen)
        return Source(sha256, path, None, seen[1])


TABLES: dict[str, type[Recording] | type[Model] | type[Tracked]] = {
    "recording": Recording, "model": Model, "tracked": Tracked,
}  # fmt: skip


def _seen(rows: list[Recording | Model | Tracked]) -> tuple[Signature | None, ...]:
    return tuple(_signature(Path(row.path)) if isinstance(row, Recording) else None for row in rows)


def _signature(path: Path) -> Signature | None:
    """What changes when a file does; None: it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_ino, found.st_size, found.st_mtime_ns)


def _digest(path: Path) -> str:
    """SHA-256 of a file; empty where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
