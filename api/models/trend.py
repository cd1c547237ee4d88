"""A participant's sessions over time: one model for each, with its figures, conditions, notes and approval.

A session is a day in the clinic: all that the rig recorded on that day, where the service stands. A recording of
another tool is a session by itself. Of all versions of a session one is shown: the approved one; where none is
approved, the newest one of its newest recording.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Row, select

from stimrig.api.clock import local_day
from stimrig.api.models import changes, stored_model
from stimrig.api.models.changes import State
from stimrig.api.models.stored_model import followed
from stimrig.api.store import Store
from stimrig.api.store.tables import Approval, Model, Note, Recording, Test

CONDITIONS = ("electrodes", "side", "posture")
"""Kinds of notes that put a comparison in doubt where they differ."""
OF_NOTE = ("at_utc", "kind", "text", "by", "test_id", "at_s")
"""What is told of a note."""
OTHER_UNITS = {
    "fit_percent": "%", "held_out_fit_percent": "%", "noise_sd_nm": "N·m", "charge_uc": "µC", "current_ma": "mA",
}  # fmt: skip
"""Figures without a standard deviation: of the fit, and of the tests of the session."""


@dataclass
class Session:
    """A session and the model that stands for it; `key` is its day, or the id of a recording of another tool."""

    key: str
    at_utc: str
    model: Any
    versions: int
    approval: Approval | None
    current_ma: float | None
    charge_uc: float | None
    test_ids: tuple[str, ...]
    notes: list[Note] = field(default_factory=list)

    @property
    def figures(self) -> dict[str, stored_model.Figure]:
        """The model's."""
        return self.model.fit.get("figures") or {}

    def state(self) -> State:
        """What is compared of it."""
        kinds = {kind: " · ".join(note.text for note in self.notes if note.kind == kind) for kind in CONDITIONS}
        structure = changes.structure_of(self.model.effects, self.figures)
        noted = tuple((kind, text) for kind, text in kinds.items() if text)
        return State(self.figures, self.model.method, structure, self.current_ma, noted)

    def document(self) -> dict[str, Any]:
        """As REST tells it."""
        fit = self.model.fit
        plain = {**fit, "charge_uc": self.charge_uc, "current_ma": self.current_ma}
        figures = {name: {**one, "uncertainty": changes.uncertainty(name, one)} for name, one in self.figures.items()}
        for name, unit in OTHER_UNITS.items():
            figures[name] = {"value": plain.get(name), "sd": None, "uncertainty": None, "unit": unit}
        approval = self.approval
        return {
            "at_utc": self.at_utc,
            "model_id": self.model.id,
            "recording_id": self.model.recording_id,
            "test_ids": list(self.test_ids),
            "versions": self.versions,
            "approved": approval is not None,
            "approved_by": approval.by if approval else None,
            "approved_utc": approval.at_utc if approval else None,
            "method": self.model.method,
            "effects": self.model.effects,
            "verdict": fit.get("verdict", "unknown"),
            "figures": figures,
            "notes": [{name: getattr(note, name) for name in OF_NOTE} for note in self.notes],
        }

    def page_document(self) -> dict[str, Any]:
        """As pages show it: `document`, with one fit, `follows_percent`; its `where` says on which pulses."""
        document = self.document()
        found = followed(self.model.fit)
        one = {"value": found.percent, "sd": None, "uncertainty": None, "unit": "%", "where": found.where}
        kept = {name: figure for name, figure in document["figures"].items() if not name.endswith("fit_percent")}
        kept["charge_uc"]["where"] = (
            f"charge of one phase, over all pulses of that day's tests ({len(self.test_ids)}), stopped ones, too"
        )
        # as the participant's page and the model's own name the model
        own = {"at_utc": self.model.created_utc, "without_evidence": self.model.fit.get("without_evidence") or []}
        return {**document, **own, "figures": {**kept, "follows_percent": one}}


class Trend:
    """Reads sessions."""

    def __init__(self, store: Store) -> None:
        self.store = store

    async def sessions(self, participant: str) -> list[Session]:
        """A participant's sessions, the oldest first."""
        return (await asyncio.to_thread(self._read, participant))[0]

    async def for_models(self, participant: str, model_ids: Sequence[str]) -> list[Session]:
        """Of each model the session in which its recording was made, with this model for it."""
        sessions, models = await asyncio.to_thread(self._read, participant)
        return [_session_of(sessions, models, model_id) for model_id in model_ids]

    async def against(self, model: Model) -> tuple[Session, Session] | None:
        """The last approved session before the model's, and the model's with that model; None where there is none."""
        sessions, models = await asyncio.to_thread(self._read, model.participant)
        own = _session_of(sessions, models, model.id)
        before = [
            one for one in sessions if one.at_utc < own.at_utc and one.approval is not None and one.key != own.key
        ]
        return (before[-1], own) if before else None

    def _read(self, participant: str) -> tuple[list[Session], dict[str, Row[Any]]]:
        """The sessions, and all models by their ids."""
        with self.store.read() as session:
            models = session.execute(_models(participant)).all()
            tests = session.execute(_tests(participant)).all()
            decisions = list(session.scalars(select(Approval).where(Approval.participant == participant)))
            noted = (Note.participant == participant, Note.struck_utc.is_(None))
            notes = list(session.scalars(select(Note).where(*noted).order_by(Note.at_utc)))
        newest = {one.model_id: one for one in sorted(decisions, key=lambda one: one.id)}
        groups: dict[str, list[Row[Any]]] = {}
        for row in models:
            groups.setdefault(_key(row), []).append(row)
        days: dict[str, list[Row[Any]]] = {}
        for test in tests:
            days.setdefault(local_day(test.requested_utc), []).append(test)
        found = [_session(key, rows, days.get(key, []), newest) for key, rows in groups.items()]
        found.sort(key=lambda one: one.at_utc)
        _attach(notes, found)
        return found, {row.id: row for row in models}


def _models(participant: str) -> Any:
    """All versions without their documents, which are long."""
    columns = (
        Model.id, Model.recording_id, Model.method, Model.effects, Model.fit, Model.created_utc,
        Recording.origin, Recording.created_utc.label("recorded_utc"), Recording.test_id,
    )  # fmt: skip
    of_models = Recording.id == Model.recording_id
    return select(*columns).join(Recording, of_models).where(Model.participant == participant)


def _tests(participant: str) -> Any:
    """What each test's session needs of it."""
    current_ma = Test.plan["profile"]["current_ma"].as_float().label("current_ma")
    columns = (Test.id, Test.requested_utc, current_ma, Test.summary["charge_uc"].as_float().label("charge_uc"))
    return select(*columns).where(Test.participant == participant).order_by(Test.requested_utc)


def _session_of(sessions: list[Session], models: dict[str, Row[Any]], model_id: str) -> Session:
    """A model's session, with this model for it."""
    row = models[model_id]
    return replace(next(one for one in sessions if one.key == _key(row)), model=row)


def _key(row: Any) -> str:
    """What a version's session is known by."""
    return local_day(row.recorded_utc) if row.origin in ("rig", "joined") else row.recording_id


def _session(key: str, rows: list[Row[Any]], here: Sequence[Row[Any]], decided: dict[str, Approval]) -> Session:
    approvals = [decided[row.id] for row in rows if row.id in decided and decided[row.id].approved]
    approval = max(approvals, key=lambda one: one.id, default=None)
    rejected = {row.id for row in rows if row.id in decided and not decided[row.id].approved}
    left = [row for row in rows if row.id not in rejected] or rows
    model = max(left, key=lambda row: (row.recorded_utc, row.created_utc))
    if approval is not None:
        model = next(row for row in rows if row.id == approval.model_id)
    own = [test for test in here if test.id == model.test_id] or here  # a joined recording is of all its tests
    charges = [test.charge_uc for test in here if test.charge_uc is not None]
    return Session(
        key=key,
        at_utc=model.recorded_utc,
        model=model,
        versions=len(rows),
        approval=approval,
        current_ma=own[-1].current_ma if own else None,
        charge_uc=sum(charges) if charges else None,
        test_ids=tuple(test.id for test in here),
    )


def _attach(notes: list[Note], sessions: list[Session]) -> None:
    """Each note to the session of its test, else to the last one of its day; what is noted elsewhere is left out."""
    by_test = {test_id: one for one in sessions for test_id in one.test_ids}
    by_day = {local_day(one.at_utc): one for one in sessions}
    for note in notes:
        one = by_test.get(note.test_id or "") or by_day.get(local_day(note.at_utc))
        if one is not None:
            one.notes.append(note)
