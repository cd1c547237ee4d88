"""The list of participants: looked through by code, most recent first, in few queries however many there are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, func, select

from stimrig.api.models.registry import Versions
from stimrig.api.store import Store
from stimrig.api.store.tables import Approval, Model, Participant, Test


@dataclass(frozen=True)
class Listed:
    """A participant in the list: its last test, its newest model, and what the controller gets."""

    participant: Participant
    last: Any
    newest: dict[str, Any] | None
    approved: Approval | None


def found(store: Store, q: str = "", archived: bool | None = None) -> list[tuple[Participant, str]]:
    """Participants whose code holds `q`, each with the time at which it was last tested, or made.

    Parameters
    ----------
    store : Store
        Holds them.
    q : str
        A part of the code, in any case; empty: all.
    archived : bool or None
        Only those that are archived, or that are not.
    """
    last = select(Test.participant, func.max(Test.requested_utc).label("utc")).group_by(Test.participant).subquery()
    newest = func.coalesce(last.c.utc, Participant.created_utc)
    query = select(Participant, newest).outerjoin(last, last.c.participant == Participant.code)
    if q.strip():
        query = query.where(Participant.code.icontains(q.strip(), autoescape=True))
    if archived is not None:
        query = query.where(Participant.archived_utc.is_not(None) if archived else Participant.archived_utc.is_(None))
    with store.read() as session:
        rows = session.execute(query.order_by(newest.desc(), Participant.code)).all()
    return [(row[0], row[1]) for row in rows]


def counts(store: Store) -> dict[str, int]:
    """How many participants there are, and how many of them are archived."""
    query = select(func.count(), func.count(Participant.archived_utc)).select_from(Participant)
    with store.read() as session:
        total, archived = session.execute(query).one()
    return {"all": total, "archived": archived}


def listed(store: Store, versions: Versions, participants: list[Participant]) -> list[Listed]:
    """What the list says of each; no plans of tests and no models are read for it."""
    codes = [row.code for row in participants]
    tests = _newest(store, Test, Test.requested_utc, codes, Test.state, Test.requested_utc)
    models = _newest(store, Model, Model.created_utc, codes, Model.fit)
    approved = versions.all_approved(codes)
    rows = []
    for row in participants:
        model = models.get(row.code)
        newest = {"id": model.id, **_judged(model, versions)} if model else None
        rows.append(Listed(row, tests.get(row.code), newest, approved.get(row.code)))
    return rows


def _newest(store: Store, table: Any, at_utc: Any, codes: list[str], *columns: Any) -> dict[str, Any]:
    """The newest row of each participant in a table, by its time: these columns of it."""
    newest = select(table.participant, func.max(at_utc).label("utc")).where(table.participant.in_(codes))
    last = newest.group_by(table.participant).subquery()
    query = select(table.id, table.participant, *columns)
    query = query.join(last, (table.participant == last.c.participant) & (at_utc == last.c.utc))
    with store.read() as session:
        return {row.participant: row for row in session.execute(query)}


def _judged(model: Row[Any], versions: Versions) -> dict[str, Any]:
    """Figures and verdict; models from before the verdict was kept beside them are read for it."""
    return model.fit if "verdict" in model.fit else {**model.fit, **versions.quality(versions.get(model.id))}
