"""What a person has to know of: one row for as long as it holds, until somebody has acknowledged it."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.errors import NotFoundError
from stimrig.api.store import Store, audit
from stimrig.api.store.centre_tables import CentreRig, CentreWarning

MOST_OPEN = 1000
"""Of a rig and a kind, as long as nobody has acknowledged them: a hostile rig fills no page."""
SHOWN = 200


def tell(session: Session, now_utc: str, rig_id: int | None, kind: str, subject: str = "", **detail: Any) -> None:
    """Note it, in the caller's transaction; what is known already is counted."""
    of = (CentreWarning.rig_id == rig_id, CentreWarning.kind == kind)
    known = select(CentreWarning).where(*of, CentreWarning.subject == subject, CentreWarning.ended_utc.is_(None))
    row = session.scalars(known.limit(1)).first()
    if row is not None:
        row.again_utc, row.times, row.detail = now_utc, min(row.times + 1, 2**31 - 1), detail
        return
    waiting = select(CentreWarning.id).where(*of, CentreWarning.acknowledged_utc.is_(None)).limit(MOST_OPEN)
    if len(session.scalars(waiting).all()) >= MOST_OPEN:
        return
    session.add(
        CentreWarning(
            rig_id=rig_id, kind=kind, subject=subject, detail=detail, at_utc=now_utc, again_utc=now_utc, times=1
        )
    )
    session.flush()


def end(session: Session, now_utc: str, rig_id: int | None, kind: str) -> None:
    """It holds no longer: what comes after is told anew."""
    _end(session, now_utc, kind, CentreWarning.rig_id == rig_id)


def mended(session: Session, now_utc: str, kind: str, subject: str) -> None:
    """It holds no longer, of whichever rig it was told."""
    _end(session, now_utc, kind, CentreWarning.subject == subject)


def _end(session: Session, now_utc: str, kind: str, of: ColumnElement[bool]) -> None:
    query = select(CentreWarning).where(of, CentreWarning.kind == kind, CentreWarning.ended_utc.is_(None))
    for row in session.scalars(query):
        row.ended_utc = now_utc


def holds(session: Session, now_utc: str, rig_id: int | None, kind: str, true: bool, **detail: Any) -> None:
    """A state that comes and goes: told while it is so."""
    if true:
        tell(session, now_utc, rig_id, kind, **detail)
    else:
        end(session, now_utc, rig_id, kind)


def listed(store: Store, acknowledged: bool = False, before: int | None = None) -> list[dict[str, Any]]:
    """Newest first: what waits to be acknowledged, or what has been."""
    column = CentreWarning.acknowledged_utc
    query = select(CentreWarning, CentreRig.name).outerjoin(CentreRig, CentreRig.id == CentreWarning.rig_id)
    query = query.where(column.is_not(None) if acknowledged else column.is_(None)).order_by(CentreWarning.id.desc())
    if before is not None:
        query = query.where(CentreWarning.id < before)
    with store.read() as session:
        return [{**row.as_dict(), "rig": name} for row, name in session.execute(query.limit(SHOWN))]


def open_count(store: Store) -> int:
    """How many wait to be acknowledged; more than `MOST_OPEN` are not counted."""
    query = select(CentreWarning.id).where(CentreWarning.acknowledged_utc.is_(None)).limit(MOST_OPEN)
    with store.read() as session:
        return len(session.scalars(query).all())


def acknowledge(store: Store, clock: Clock, warning_id: int, by: str) -> None:
    """A person has seen it. Raises NotFoundError."""
    with store.write() as session:
        row = session.get(CentreWarning, warning_id) if 0 < warning_id < 2**31 else None
        if row is None:
            raise NotFoundError("warning", str(warning_id), "GET /v1/warnings lists them.")
        if row.acknowledged_utc is None:
            now = clock.utc()
            row.acknowledged_by, row.acknowledged_utc = by, now
            audit.write(session, now, by, "acknowledge warning", str(row.id), kind=row.kind)
