"""What the centre looks after: rigs that have not been seen, files that wait for the bucket, and those that lie in it.

These are read again and compared with their hashes when somebody asks; what is lost is asked of the rigs once more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sqlalchemy import ColumnElement, func, select

from stimrig.api.centre import warnings
from stimrig.api.centre.bucket import Bucket, BucketError, MissingError
from stimrig.api.centre.project import want
from stimrig.api.centre.spool import Spool
from stimrig.api.clock import Clock, utc_label
from stimrig.api.store import Store
from stimrig.api.store.centre_tables import CentreFile, CentreItem, CentreRig, CentreWarning

PAGE = 500
EVERY_S = 30.0
UNSEEN_S = 24 * 3600.0


@dataclass(frozen=True)
class CheckedFile:
    """One file that was read again."""

    sha256: str
    ok: bool
    words: str


def _not_since(before_utc: str) -> ColumnElement[bool]:
    """Files that were not checked since a time."""
    return (CentreFile.checked_utc.is_(None)) | (CentreFile.checked_utc < before_utc)


def left_bytes(store: Store, before_utc: str) -> int:
    """How much is to be read."""
    with store.read() as session:
        return int(session.scalar(select(func.sum(CentreFile.bytes)).where(_not_since(before_utc))) or 0)


def check(
    store: Store, bucket: Bucket, clock: Clock, before_utc: str, seen: Callable[[int], object] | None = None
) -> Iterator[CheckedFile]:
    """Check all files that were not checked since `before_utc`; each is noted when it is done, so a cut run goes on.

    Raises BucketError: the bucket cannot be read at all.
    """
    after, own = "", CentreFile
    while names := store.all(own.sha256, own.sha256 > after, _not_since(before_utc), order=own.sha256, limit=PAGE):
        for after in names:
            try:
                ok, words = bucket.copy(after, seen=seen), "its content is another than its name says"
            except MissingError:
                ok, words = False, "it is not in the bucket"
            note(store, clock, after, ok, words)
            yield CheckedFile(after, ok, "" if ok else words)


def note(store: Store, clock: Clock, sha256: str, ok: bool, words: str = "") -> None:
    """Keep what was found; a file that is lost is warned of, and asked for again."""
    now = clock.utc()
    with store.write() as session:
        row = session.get(CentreFile, sha256)
        if row is None:
            return
        row.checked_utc, row.ok = now, ok
        if ok:
            warnings.end(session, now, "damaged", CentreWarning.subject == sha256)
            return
        of = select(CentreItem.rig_id).where(CentreItem.file == sha256).distinct().limit(100)
        rigs = session.scalars(of).all()
        warnings.tell(session, now, rigs[0] if rigs else None, "damaged", sha256, words=words)
        for rig_id in rigs:
            want(session, rig_id, sha256, row.bytes)


def look(spool: Spool) -> None:
    """Once: rigs, and the bucket."""
    unseen(spool.store, spool.clock)
    try:
        spool.settle()
        spool.bucket.ready()
    except BucketError as error:
        _note(spool, str(error))
    else:
        _note(spool, None)


def unseen(store: Store, clock: Clock) -> None:
    """Warn of rigs that have not been seen for a day."""
    now, limit = clock.utc(), utc_label(clock.unix_s() - UNSEEN_S)
    late = (CentreRig.revoked_utc.is_(None), CentreRig.seen_utc.is_not(None), CentreRig.seen_utc < limit)
    known = select(CentreWarning.rig_id).where(CentreWarning.kind == "unseen", CentreWarning.ended_utc.is_(None))
    with store.read() as session:
        told = set(session.scalars(known).all())
        rows = [row for row in session.scalars(select(CentreRig).where(*late)) if row.id not in told]
    if rows:
        with store.write() as session:
            for row in rows:
                warnings.tell(session, now, row.id, "unseen", since_utc=row.seen_utc)


def _note(spool: Spool, trouble: str | None) -> None:
    """Warn of the bucket while it cannot be used; nothing is written while all is well."""
    open_ones = (CentreWarning.kind == "bucket", CentreWarning.ended_utc.is_(None))
    known = spool.store.first(CentreWarning, *open_ones) is not None
    if known != (trouble is not None):
        with spool.store.write() as session:
            warnings.holds(session, spool.clock.utc(), None, "bucket", trouble is not None, words=trouble or "")
