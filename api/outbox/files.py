"""The files that items name: found by their SHA-256, looked through, and sent chunk by chunk, the oldest first."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import select

from stimrig.api.outbox.link import Link
from stimrig.api.outbox.messages import LackingOut, RefusedError, UnreachableError, WrongAnswerError
from stimrig.api.store import Store
from stimrig.api.store.tables import Model, OutboxItem, Recording, Tracked
from stimrig.api.whole_file import sha256_of

CHUNK = 8_000_000
PIECE = 65536
PAGE = 100
MOST_ASKED = 1000
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

    `damaged`: SHA-256 of each file that is missing or has another content, with what was seen of it: it is looked
    through again only once that changes.
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
        if seen is None or not row.path:
            return None
        if self._whole != (sha256, path, seen):
            try:
                if sha256_of(path) != sha256 or _signature(path) != seen:
                    return None
            except OSError:
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


class Sending:
    """Sends a centre the files that it lacks.

    `queue`: what it lacked when it was last asked, without what is damaged here; `asked`: whether it was asked since
    something new was told.
    """

    def __init__(self, link: Link, files: Files) -> None:
        self.link, self.files = link, files
        self.queue: deque[LackingOut] = deque()
        self.asked = False
        self._other_offset = False

    def ask(self) -> None:
        """Learn what the centre lacks. Damaged files stand before the others until they are mended: more is asked."""
        limit = min(PAGE + len(self.files.damaged), MOST_ASKED)
        wanted = self.link.wanted(limit)
        self.queue = deque(each for each in wanted if self.files.source_known(each.sha256))
        self.asked = len(wanted) < limit  # else there is more after these

    def step(self, share: float = 1.0) -> bool:
        """Send a chunk, at most `share` of the largest; whether there may be more to do at once.

        Not at once after what cost a look at the disk and sent nothing: a centre that asks for the same again and
        again has no file read faster than one a rest.
        """
        if not self.queue:
            if self.asked:
                return False
            self.ask()
            if not self.queue:
                self.asked = True
                return False
        wanted = self.queue[0]
        source = self.files.source(wanted.sha256)
        if source is None:
            self.queue.popleft()
            return not self.files.unknown(wanted.sha256)
        if wanted.have_bytes > source.size:
            self.queue.popleft()
            raise WrongAnswerError(f"{self.link.url}: has more of {wanted.sha256[:12]}… than there is")
        self._send(wanted, source, max(1, int(CHUNK * share)))
        return wanted.have_bytes < source.size

    def _send(self, wanted: LackingOut, source: Source, most: int) -> None:
        length = min(most, source.size - wanted.have_bytes)
        try:
            given = self.link.send(wanted.sha256, wanted.have_bytes, source.pieces(wanted.have_bytes, length), length)
        except RefusedError as error:
            self._refused(wanted, source, error)
            return
        except (UnreachableError, OSError):
            self.files.doubt(wanted.sha256)  # it may have been cut here
            raise
        self._other_offset = False
        if given.whole and given.have_bytes == source.size:
            self.queue.popleft()
        elif given.whole or given.have_bytes != wanted.have_bytes + length or length == 0:
            self.queue.clear()
            self.asked = False
            raise WrongAnswerError(f"{self.link.url}: counts the bytes of {wanted.sha256[:12]}… otherwise than the rig")
        else:
            self.queue[0] = wanted.model_copy(update={"have_bytes": given.have_bytes})

    def _refused(self, wanted: LackingOut, source: Source, error: RefusedError) -> None:
        """Go on from where the centre says it is, once; else it is asked again, later."""
        if error.code == "other-offset" and not self._other_offset:
            have = error.number("have_bytes")
            if have <= source.size:
                self._other_offset = True
                self.queue[0] = wanted.model_copy(update={"have_bytes": have})
                return
        self._other_offset = False
        self.files.doubt(wanted.sha256)
        self.queue.clear()
        self.asked = False
        raise error
