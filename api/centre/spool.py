"""Files on their way in: each grows in the data folder, is compared with its hash, and goes into the bucket."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import delete, select

from stimrig.api import owner_only
from stimrig.api.centre import rigs, warnings
from stimrig.api.centre.bucket import Bucket, BucketError, failed, first_line
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.store import Store
from stimrig.api.store.centre_tables import CentreFile, CentreRig, CentreWanted, CentreWarning
from stimrig.api.whole_file import sha256_of

MOST_PIECE_BYTES = 8_000_000
MOST_LISTED = 1000
MOST_PARTS, MOST_BYTES = 8, 8_000_000_000
"""Files of one rig on their way at the same time, and their bytes beside the one that grows.

The oldest is thrown away, and is sent again.
"""


class Spool:
    """Takes files of rigs, piece by piece.

    A rig's parts lie in a folder of its own: no rig can spoil another one's.
    """

    def __init__(self, folder: Path, store: Store, clock: Clock, bucket: Bucket) -> None:
        self.folder, self.store, self.clock, self.bucket = folder, store, clock, bucket

    def lacking(self, rig: CentreRig, limit: int) -> list[dict[str, Any]]:
        """Files that the rig named and the centre lacks, the oldest first."""
        query = CentreWanted.rig_id == rig.id
        rows = self.store.all(CentreWanted, query, order=CentreWanted.id, limit=min(limit, MOST_LISTED))
        return [
            {"sha256": row.sha256, "bytes": row.bytes, "have_bytes": self._length(self.part(rig.id, row.sha256))}
            for row in rows
        ]

    def part(self, rig_id: int, sha256: str) -> Path:
        """Where a file lies until it is whole."""
        return self.folder / str(rig_id) / f"{sha256}.part"

    def put(self, rig: CentreRig, sha256: str, offset: int, data: bytes) -> dict[str, Any]:
        """Append a piece; once it is whole the file goes into the bucket.

        Raises ApiError: 404 no item names it; 409 `other-offset`; 422 `hash-differs`; 507 `bucket-failed`.
        """
        length, whole = self._wanted(rig, sha256)
        if whole:
            return {"have_bytes": length, "whole": True}
        try:
            with self._held(rig.id, sha256) as part:
                have = self._append(part, offset, data, length)
                if have < length:
                    return {"have_bytes": have, "whole": False}
                self._finish(part, sha256, length)
        except BucketError as error:
            raise failed(error) from error
        except OSError as error:
            raise failed(BucketError(f"the centre's data folder: {first_line(error)}")) from error
        return {"have_bytes": length, "whole": True}

    def _wanted(self, rig: CentreRig, sha256: str) -> tuple[int, bool]:
        """A file's length, and whether it is whole already."""
        with self.store.read() as session:
            rigs.still(session, rig, hold=False)
            of = select(CentreWanted.bytes).where(CentreWanted.sha256 == sha256, CentreWanted.rig_id == rig.id)
            length = session.scalars(of).first()
            known = session.get(CentreFile, sha256)
        if known is not None and known.ok:
            return known.bytes, True
        if length is None:
            raise NotFoundError("file", sha256, "No item of this rig names it, or it is too long. Send the item first.")
        return length, False

    def _append(self, part: Path, offset: int, data: bytes, length: int) -> int:
        have = self._length(part)
        if offset != have:
            detail = f"The centre has {have} bytes of it. Go on from there."
            raise ApiError(409, "other-offset", "The file goes on elsewhere", detail, have_bytes=have)
        if have + len(data) > length:
            part.unlink(missing_ok=True)
            raise _differs(f"It is longer than the {length} bytes that its item says")
        with part.open("ab") as out:
            out.write(data)
            out.flush()
            if have + len(data) == length:
                os.fsync(out.fileno())
        return have + len(data)

    def _finish(self, part: Path, sha256: str, length: int) -> None:
        if sha256_of(part) != sha256:
            part.unlink(missing_ok=True)
            raise _differs("Its content is another than its name says")
        self.bucket.put(part, sha256)
        now = self.clock.utc()
        with self.store.write() as session:
            session.merge(CentreFile(sha256=sha256, bytes=length, whole_utc=now, checked_utc=now, ok=True))
            session.execute(delete(CentreWanted).where(CentreWanted.sha256 == sha256))
            warnings.end(session, now, "damaged", CentreWarning.subject == sha256)
        part.unlink(missing_ok=True)

    def settle(self) -> int:
        """Bring into the bucket what is whole and could not be kept before; throw away what nobody waits for.

        Raises BucketError: it still cannot.
        """
        count = 0
        for part in sorted(self.folder.glob("*/*.part")):
            rig_id, sha256 = part.parent.name, part.name.removesuffix(".part")
            rows = self.store.all(CentreWanted, CentreWanted.sha256 == sha256, CentreWanted.rig_id == int(rig_id))
            if not rows:
                part.unlink(missing_ok=True)
            elif self._length(part) == rows[0].bytes:
                with self._held(int(rig_id), sha256) as held:
                    if self._length(held) == rows[0].bytes:
                        with contextlib.suppress(ApiError):  # it differed, is gone, and will be sent again
                            self._finish(held, sha256, rows[0].bytes)
                        count += 1
        return count

    @contextmanager
    def _held(self, rig_id: int, sha256: str) -> Iterator[Path]:
        """The part, for nobody else meanwhile, whichever process asks."""
        part = self.part(rig_id, sha256)
        owner_only.folder(part.parent)
        with (part.parent / "lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            others = sorted(part.parent.glob("*.part"), key=lambda path: path.stat().st_mtime)
            others = [path for path in others if path != part]
            while others and (len(others) >= MOST_PARTS or sum(map(self._length, others)) > MOST_BYTES):
                others.pop(0).unlink(missing_ok=True)
            yield part

    def _length(self, part: Path) -> int:
        try:
            return part.stat().st_size
        except FileNotFoundError:
            return 0


def _differs(why: str) -> ApiError:
    detail = f"{why}. What was there is thrown away: send it again from the beginning."
    return ApiError(422, "hash-differs", "The file differs from its hash", detail)
