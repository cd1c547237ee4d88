"""Reads the bucket's files again and compares them with their hashes; what is lost is asked of the rigs once more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sqlalchemy import func, select

from api.centre import warnings
from api.centre.bucket import Bucket, MissingError
from api.centre.project import want
from api.clock import Clock
from api.store import Store
from api.store.centre_tables import CentreFile, CentreItem

PAGE = 500


@dataclass(frozen=True)
class Found:
    """One file that was read again."""

    sha256: str
    bytes: int
    ok: bool
    words: str


def pending(store: Store, before_utc: str, after: str = "") -> list[CentreFile]:
    """Files that were not checked since a time, in order of their names."""
    checked = (CentreFile.checked_utc.is_(None)) | (CentreFile.checked_utc < before_utc)
    return store.all(CentreFile, CentreFile.sha256 > after, checked, order=CentreFile.sha256, limit=PAGE)


def left_bytes(store: Store, before_utc: str) -> int:
    """How much is to be read."""
    checked = (CentreFile.checked_utc.is_(None)) | (CentreFile.checked_utc < before_utc)
    with store.read() as session:
        return int(session.scalar(select(func.sum(CentreFile.bytes)).where(checked)) or 0)


def check(
    store: Store, bucket: Bucket, clock: Clock, before_utc: str, seen: Callable[[int], object] | None = None
) -> Iterator[Found]:
    """Check all files that were not checked since `before_utc`; each is noted when it is done, so a cut run goes on.

    Raises
    ------
    BucketError
        The bucket cannot be read at all.
    """
    after = ""
    while rows := pending(store, before_utc, after):
        for row in rows:
            after = row.sha256
            yield one(store, bucket, clock, row.sha256, row.bytes, seen)


def one(
    store: Store, bucket: Bucket, clock: Clock, sha256: str, length: int, seen: Callable[[int], object] | None = None
) -> Found:
    """Check one file, and note it."""
    try:
        ok, words = bucket.copy(sha256, seen=seen), "its content is another than its name says"
    except MissingError:
        ok, words = False, "it is not in the bucket"
    note(store, clock, sha256, ok, words)
    return Found(sha256, length, ok, "" if ok else words)


def note(store: Store, clock: Clock, sha256: str, ok: bool, words: str = "") -> None:
    """Keep what was found; a file that is lost is warned of, and asked for again."""
    now = clock.utc()
    with store.write() as session:
        row = session.get(CentreFile, sha256)
        if row is None:
            return
        row.checked_utc, row.ok = now, ok
        if ok:
            warnings.mended(session, now, "damaged", sha256)
            return
        of = select(CentreItem.rig_id).where(CentreItem.file == sha256).distinct().limit(100)
        rigs = session.scalars(of).all()
        warnings.tell(session, now, rigs[0] if rigs else None, "damaged", sha256, words=words)
        for rig_id in rigs:
            want(session, rig_id, sha256, row.bytes)
