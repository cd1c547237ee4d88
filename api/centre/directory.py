"""What the pages ask: participants, sessions, recordings. Every query by an index; paged by key, never by offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, exists, select, tuple_

from stimrig.api.centre import clean
from stimrig.api.clock import local_day
from stimrig.api.errors import invalid, require_found
from stimrig.api.models.stored_model import VERDICTS
from stimrig.api.store import Store
from stimrig.api.store.centre_tables import (
    CentreDecision,
    CentreEffect,
    CentreModel,
    CentreParticipant,
    CentreRecording,
    CentreRig,
    CentreSession,
    CentreTest,
)  # fmt: skip

PARTICIPANTS, SESSIONS = 50, 12
MOST_IN_A_SESSION = 400
"""Recordings, tests, models of a page of sessions."""
MOST_IN_A_TREND = 200
VERDICT_NAMES = (*VERDICTS, "unknown")
LAST = "\U0010ffff"
"""Sorts after every text."""


@dataclass(frozen=True)
class Search:
    """What participants are searched for; None: whatever."""

    q: str = ""
    rig_id: int | None = None
    from_day: str | None = None
    to_day: str | None = None
    effect: str | None = None
    verdict: str | None = None
    after: str = ""


def asked(
    store: Store, q: str = "", rig: str | None = None, from_: str | None = None, to: str | None = None,
    effect: str | None = None, verdict: str | None = None, after: str | None = None,
) -> Search:  # fmt: skip
    """A search, each part checked. Raises ApiError: 422 a part does not hold; 404 no such rig."""
    for name, given in (("from", from_), ("to", to)):
        if given and clean.a_day(given) is None:
            raise invalid(f"{name}: give a day as 2026-11-23")
    if effect and not clean.EFFECT.fullmatch(effect):
        raise invalid("effect: give an effect's id, as fatigue")
    if verdict and verdict not in VERDICT_NAMES:
        raise invalid(f"verdict: one of {', '.join(VERDICT_NAMES)}")
    if after and clean.code(after) is None:
        raise invalid("after: give it as the last page gave it")
    rig_id = the_rig(store, rig).id if rig else None
    return Search(q.strip()[:32], rig_id, from_ or None, to or None, effect or None, verdict or None, after or "")


def the_rig(store: Store, name: str) -> CentreRig:
    """A rig by its name. Raises NotFoundError."""
    row = store.first(CentreRig, CentreRig.name == name[:80])
    return require_found(row, "rig", name[:80], "GET /v1/rigs lists them.")


def participants(store: Store, asked: Search, limit: int = PARTICIPANTS) -> tuple[list[dict[str, Any]], str | None]:
    """A page of participants, by code; the code after which the next page begins, or None."""
    query = _codes(asked).order_by(CentreParticipant.code).distinct().limit(limit + 1)
    with store.read() as session:
        codes = list(session.scalars(query))
        of = select(CentreParticipant, CentreRig.name).join(CentreRig, CentreRig.id == CentreParticipant.rig_id)
        rows = session.execute(of.where(CentreParticipant.code.in_(codes[:limit]))).all()
    found: dict[str, dict[str, Any]] = {}
    for row, rig in sorted(rows, key=lambda pair: (pair[0].code, pair[0].last_utc or "")):
        one = found.setdefault(row.code, {"code": row.code, "rigs": [], "sessions": 0, "recordings": 0})
        one["rigs"].append(rig)
        one["sessions"] += row.sessions
        one["recordings"] += row.recordings
        one.update(last_utc=row.last_utc, verdict=row.verdict, side=row.side, muscle=row.muscle)
    return list(found.values()), codes[limit - 1] if len(codes) > limit else None


def _codes(asked: Search) -> Select[Any]:
    own, past, held = CentreParticipant, CentreSession, CentreEffect
    query = select(own.code).where(own.code > asked.after)
    if asked.q:
        query = query.where(own.code >= asked.q, own.code < asked.q + LAST)
    if asked.rig_id is not None:
        query = query.where(own.rig_id == asked.rig_id)
    if asked.from_day or asked.to_day or asked.verdict:
        same = [past.participant == own.code, past.rig_id == own.rig_id]
        same += [past.day >= asked.from_day] if asked.from_day else []
        same += [past.day <= asked.to_day] if asked.to_day else []
        same += [past.verdict == asked.verdict] if asked.verdict else []
        query = query.where(exists().where(*same))
    if asked.effect:
        same = [held.effect == asked.effect, held.participant == own.code, held.rig_id == own.rig_id]
        query = query.where(exists().where(*same))
    return query


def person(store: Store, code: str) -> list[dict[str, Any]]:
    """A participant at each of its rigs; empty where there is none."""
    of = select(CentreParticipant, CentreRig.name).join(CentreRig, CentreRig.id == CentreParticipant.rig_id)
    with store.read() as session:
        rows = session.execute(of.where(CentreParticipant.code == code)).all()
    return [{**row.as_dict(), "rig": name} for row, name in rows]


def require(store: Store, code: str) -> None:
    """Whether there is such a participant. Raises NotFoundError."""
    require_found(person(store, code) or None, "participant", code, "GET /v1/participants lists them.")


def sessions(
    store: Store, code: str, before: tuple[str, int] | None = None, limit: int = SESSIONS
) -> tuple[list[dict[str, Any]], tuple[str, int] | None]:
    """A participant's sessions over all rigs, newest first, with what was made in them; the key of the next page."""
    own = CentreSession
    query = select(own, CentreRig.name).join(CentreRig, CentreRig.id == own.rig_id).where(own.participant == code)
    if before is not None:
        query = query.where(tuple_(own.day, own.rig_id) < tuple_(*before))
    with store.read() as session:
        rows = session.execute(query.order_by(own.day.desc(), own.rig_id.desc()).limit(limit + 1)).all()
    more = (rows[limit - 1][0].day, rows[limit - 1][0].rig_id) if len(rows) > limit else None
    found = [{**row.as_dict(), "rig": name} for row, name in rows[:limit]]
    _fill(store, code, found)
    return found, more


def page_key(before: str | None) -> tuple[str, int] | None:
    """Where a page of sessions begins. Raises ApiError (422)."""
    if not before:
        return None
    day, _, number = before.partition("~")
    if clean.a_day(day) is None or (number and (not number.isdecimal() or len(number) > 9)):
        raise invalid("before: give it as the last page gave it")
    return day, int(number or 0)


def _fill(store: Store, code: str, found: list[dict[str, Any]]) -> None:
    """Put tests, recordings, models and decisions to their sessions."""
    if not found:
        return
    first, last = min(one["at_utc"] for one in found), max(one["day"] for one in found)
    parts: dict[str, tuple[Any, Any]] = {
        "made_tests": (CentreTest, CentreTest.requested_utc),
        "made_recordings": (CentreRecording, CentreRecording.created_utc),
        "models": (CentreModel, CentreModel.created_utc),
        "decisions": (CentreDecision, CentreDecision.at_utc),
    }
    # two days later is behind all of a day's labels, in whatever time zone the day is
    by_day = {(one["day"], one["rig_id"]): one for one in found}
    for name, (table, at) in parts.items():
        for one in found:
            one[name] = []
        held = select(table).where(table.participant == code, at >= first, at < f"{clean.days_later(last, 2)}T")
        with store.read() as session:
            rows = session.scalars(held.order_by(at.desc()).limit(MOST_IN_A_SESSION)).all()
        for row in rows:
            one = by_day.get((local_day(getattr(row, at.key)), row.rig_id))
            if one is not None:
                one[name].append(row)


def stood(store: Store, code: str) -> list[dict[str, Any]]:
    """A participant's newest sessions with a model, each with that model, oldest first: what a trend is drawn from."""
    own, made = CentreSession, CentreModel
    query = (
        select(own, made, CentreRig.name)
        .join(made, (made.rig_id == own.rig_id) & (made.id == own.model_id))
        .join(CentreRig, CentreRig.id == own.rig_id)
        .where(own.participant == code, own.model_id.is_not(None))
        .order_by(own.day.desc(), own.rig_id.desc())
        .limit(MOST_IN_A_TREND)
    )
    with store.read() as session:
        rows = session.execute(query).all()
    return [{"session": one, "model": model, "rig": rig} for one, model, rig in reversed(rows)]


@dataclass(frozen=True)
class Cohort:
    """Which recordings are asked for; None: whichever. `after` is the last one's key."""

    participant: str | None = None
    rig_id: int | None = None
    from_utc: str | None = None
    to_utc: str | None = None
    after: str | None = None


def recordings(store: Store, asked: Cohort, limit: int) -> tuple[list[dict[str, Any]], str | None]:
    """Recordings in order of time; the key of the next page, or None."""
    own = CentreRecording
    query = select(own, CentreRig.name).join(CentreRig, CentreRig.id == own.rig_id)
    query = query.where(own.participant == asked.participant) if asked.participant else query
    query = query.where(own.rig_id == asked.rig_id) if asked.rig_id is not None else query
    query = query.where(own.created_utc >= asked.from_utc) if asked.from_utc else query
    query = query.where(own.created_utc < asked.to_utc) if asked.to_utc else query
    if asked.after:
        query = query.where(tuple_(own.created_utc, own.id) > tuple_(*_key(asked.after)))
    with store.read() as session:
        rows: Sequence[Any] = session.execute(query.order_by(own.created_utc, own.id).limit(limit + 1)).all()
    found = [document(row, rig) for row, rig in rows[:limit]]
    last = rows[limit - 1][0] if len(rows) > limit else None
    return found, f"{last.created_utc}~{last.id}" if last is not None else None


def document(row: CentreRecording, rig: str) -> dict[str, Any]:
    """A recording as REST tells it."""
    held = {name: value for name, value in row.as_dict().items() if name != "rig_id"}
    return {**held, "rig": rig, "url": f"/v1/recordings/{row.id}"}


def _key(after: str) -> tuple[str, int]:
    label, mark, number = after.partition("~")
    if not mark or not number.isdecimal() or len(number) > 18 or clean.label(label, "") != label:
        raise invalid("after: give it as the last page gave it")
    return label, int(number)
