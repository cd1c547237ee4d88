"""What the centre looks after by itself: rigs that have not been seen, files that wait for the bucket."""

from __future__ import annotations

from typing import Protocol

from sqlalchemy import select

from api.centre import warnings
from api.centre.bucket import Bucket, BucketError
from api.centre.spool import Spool
from api.clock import Clock, utc_label
from api.store import Store
from api.store.centre_tables import CentreRig, CentreWarning

EVERY_S = 30.0
UNSEEN_S = 24 * 3600.0


class Looked(Protocol):
    """What is looked after."""

    store: Store
    clock: Clock
    spool: Spool
    bucket: Bucket


def look(context: Looked) -> None:
    """Once: rigs, and the bucket."""
    unseen(context.store, context.clock)
    try:
        context.spool.settle()
        context.bucket.ready()
    except BucketError as error:
        _note(context, str(error))
    else:
        _note(context, None)


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


def _note(context: Looked, trouble: str | None) -> None:
    """Warn of the bucket while it cannot be used; nothing is written while all is well."""
    open_ones = (CentreWarning.kind == "bucket", CentreWarning.ended_utc.is_(None))
    known = bool(context.store.all(CentreWarning, *open_ones, limit=1))
    if known != (trouble is not None):
        with context.store.write() as session:
            warnings.holds(session, context.clock.utc(), None, "bucket", trouble is not None, words=trouble or "")
