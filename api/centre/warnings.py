# ruff: noqa: E501
"""What a person has to know of: a row for as long as it holds, until somebody has acknowledged it; and its words."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session
from stimrig.api.store.centre_tables import CentreRig, CentreWarning

from stimrig.api import local_time
from stimrig.api.clock import Clock
from stimrig.api.errors import NotFoundError
from stimrig.api.store import Store, audit

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


def end(session: Session, now_utc: str, kind: str, of: ColumnElement[bool]) -> None:
    """It holds no longer, of a rig or of a subject: what comes after is told anew."""
    query = select(CentreWarning).where(of, CentreWarning.kind == kind, CentreWarning.ended_utc.is_(None))
    for row in session.scalars(query):
        row.ended_utc = now_utc


def holds(session: Session, now_utc: str, rig_id: int | None, kind: str, true: bool, **detail: Any) -> None:
    """A state that comes and goes: told while it is so."""
    if true:
        tell(session, now_utc, rig_id, kind, **detail)
    else:
        end(session, now_utc, kind, CentreWarning.rig_id == rig_id)


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


TITLES: dict[str, Any] = {
    "restored": "The rig was restored from a backup",
    "forked": "The rig's chain has forked",
    "damaged-at-rig": "A file at the rig differs from its hash",
    "damaged": "A file of the centre differs from its hash",
    "changed": "A recording or model was told twice, with another file",
    "unreadable": "Something that the rig told cannot be read",
    "too-long": "A file is too long to be taken",
    "audit": "The rig's audit trail has changed",
    "clock": "The rig's clock is off",
    "disk": "The rig's disk is nearly full",
    "unseen": "The rig has not been seen for a day",
    "bucket": "The centre's bucket cannot be used",
}
ADVICE: dict[str, Any] = {
    "restored": "It knows its chain up to item {seq} only. What the centre has beyond that is kept; the rig may lack it.",
    "anew": "It has begun a new chain without the one before. What the centre has is kept; the rig may lack it.",
    "forked": (
        "Two databases push with one key, or one was changed by hand. Nothing was overwritten. See that only one rig "
        "has this key."
    ),
    "damaged-at-rig": "{subject} was changed after it was sealed, and is not taken. Look for a copy in the rig's backup.",
    "damaged": "{short} is not handed out. Its rigs are asked for it again; else restore it from the bucket's backup.",
    "changed": "{subject}: the first file is kept. Compare both at the rig.",
    "unreadable": "It is kept as it came, and shown nowhere. Is the rig's stimrig older or newer than the centre's?",
    "too-long": "It has {megabytes} MB, and stays at the rig. The longest that is taken is set by STIMRIG_CENTRE_MAX_FILE_MB.",
    "audit": "Entry {seq} is not the one that was told before. Verify the trail at the rig, and compare with a backup.",
    "ahead": "It is {seconds} s ahead of the centre's. Set both by NTP.",
    "behind": "It is {seconds} s behind the centre's. Set both by NTP.",
    "no-time": "It tells a time that cannot be read. Set its clock by NTP.",
    "disk": "{free_gb} GB are free. When it is full, no test can be recorded.",
    "unseen": "Last on {when}. Its work goes on without the centre. See whether it is switched on and has a network.",
    "bucket": "{words}. Files wait at the rigs and in the data folder; nothing is lost.",
}


def title(warning: dict[str, Any]) -> str:
    """What was found."""
    return str(TITLES.get(warning["kind"], warning["kind"]))


def advice(warning: dict[str, Any]) -> str:
    """What it means, and what to do."""
    detail, subject = warning["detail"], str(warning["subject"])
    words = ADVICE.get(_case(warning["kind"], detail))
    if words is None:
        return ""
    return str(words).format(
        subject=subject[:80], short=f"{subject[:12]}…", seq=detail.get("seq"),
        megabytes=_number(detail.get("megabytes")), free_gb=_number(detail.get("free_gb")),
        seconds=_number(detail.get("difference_s")), when=_when(detail.get("since_utc")),
        words=str(detail.get("words") or "")[:300],
    )  # fmt: skip


def _case(kind: str, detail: dict[str, Any]) -> str:
    """Which advice: some kinds have more than one."""
    if kind == "restored" and not isinstance(detail.get("seq"), int):
        return "anew"
    if kind == "clock":
        off_s = detail.get("difference_s")
        return "no-time" if not isinstance(off_s, int | float) else "ahead" if off_s > 0 else "behind"
    return kind


def _number(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "?"
    return f"{abs(value):.1f}"


def _when(value: Any) -> str:
    return local_time.when(value) if isinstance(value, str) and value else "?"
