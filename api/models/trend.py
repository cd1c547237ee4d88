"""A participant's sessions over time: one model for each, with its figures, conditions, notes and approval.

A session is a day in the clinic: all that the rig recorded on that day, where the service stands. A recording of
another tool is a session by itself. Of all versions of a session one is shown: the approved one; where none is
approved, the newest one of its newest recording.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import select

from stimrig.api.clock import local_day
from stimrig.api.models import changes
from stimrig.api.store import Store
from stimrig.api.store.tables import Approval, Model, Note, Recording, Test

NOTE_FIELDS = ("at_utc", "kind", "text", "by", "test_id", "at_s")
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
    test_ids: list[str]
    notes: list[Note] = field(default_factory=list)

    def state(self) -> changes.State:
        """Return what is compared of it."""
        figures = self.model.fit.get("figures") or {}
        texts = {kind: " · ".join(note.text for note in self.notes if note.kind == kind) for kind in changes.CONDITIONS}
        structure = changes.structure_of(self.model.effects, figures)
        return changes.State(figures, self.model.method, structure, self.current_ma, texts)

    def document(self) -> dict[str, Any]:
        """Return it as REST answers it."""
        fit, approval = self.model.fit, self.approval
        figures = {name: {**figure, "uncertainty": changes.uncertainty(name, figure)}
                   for name, figure in (fit.get("figures") or {}).items()}  # fmt: skip
        others = {**fit, "charge_uc": self.charge_uc, "current_ma": self.current_ma}
        figures |= {name: {"value": others.get(name), "sd": None, "uncertainty": None, "unit": unit}
                    for name, unit in OTHER_UNITS.items()}  # fmt: skip
        return {
            "at_utc": self.at_utc,
            "model_id": self.model.id,
            "recording_id": self.model.recording_id,
            "test_ids": self.test_ids,
            "versions": self.versions,
            "approved": approval is not None,
            "approved_by": approval and approval.by,
            "approved_utc": approval and approval.at_utc,
            "method": self.model.method,
            "effects": self.model.effects,
            "without_evidence": fit.get("without_evidence") or [],
            "verdict": fit.get("verdict", "unknown"),
            "figures": figures,
            "notes": [{name: getattr(note, name) for name in NOTE_FIELDS} for note in self.notes],
        }


def changes_between(before: Session, now: Session) -> dict[str, Any]:
    """Return what changed between two sessions, in figures and in words."""
    old, new = before.state(), now.state()
    return {
        "since_utc": before.at_utc,
        "since_model_id": before.model.id,
        "model_id": now.model.id,
        "differences": changes.changed(old, new),
        "sentences": changes.sentences(old, new, before.at_utc),
        "doubts": changes.doubt_sentences(old, new),
    }


def newest_changes(sessions: Sequence[Session]) -> dict[str, Any] | None:
    """Return what changed from the last approved session before the newest one; None where there is none."""
    approved = [session for session in sessions[:-1] if session.approval is not None]
    return changes_between(approved[-1], sessions[-1]) if approved else None


def changes_to(store: Store, model: Model) -> dict[str, Any] | None:
    """Return what changed to a model from the last approved session before it; None where there is none."""
    known, models = _read(store, model.participant)
    row = models[model.id]
    now = replace(next(session for session in known if session.key == _key(row)), model=row)
    return newest_changes(
        [*(session for session in known if session.at_utc < now.at_utc and session.key != now.key), now]
    )


def sessions(store: Store, participant: str) -> list[Session]:
    """Return a participant's sessions, the oldest first."""
    return _read(store, participant)[0]


def _read(store: Store, participant: str) -> tuple[list[Session], dict[str, Any]]:
    """Return the sessions, and all models by their ids without their documents, which are long."""
    columns = (
        Model.id, Model.recording_id, Model.method, Model.effects, Model.fit, Model.created_utc,
        Recording.origin, Recording.created_utc.label("recorded_utc"), Recording.test_id,
    )  # fmt: skip
    test_columns = (
        Test.id, Test.requested_utc, Test.plan["profile"]["current_ma"].as_float().label("current_ma"),
        Test.summary["charge_uc"].as_float().label("charge_uc"),
    )  # fmt: skip
    with store.read() as session:
        of_models = select(*columns).join(Recording, Recording.id == Model.recording_id)
        models = session.execute(of_models.where(Model.participant == participant)).all()
        of_tests = select(*test_columns).where(Test.participant == participant).order_by(Test.requested_utc)
        tests = session.execute(of_tests).all()
        of_approvals = select(Approval).where(Approval.participant == participant).order_by(Approval.id)
        decisions = {approval.model_id: approval for approval in session.scalars(of_approvals)}
        of_notes = select(Note).where(Note.participant == participant, Note.struck_utc.is_(None))
        notes = list(session.scalars(of_notes.order_by(Note.at_utc)))
    groups, days = defaultdict[str, list[Any]](list), defaultdict[str, list[Any]](list)
    for row in models:
        groups[_key(row)].append(row)
    for test in tests:
        days[local_day(test.requested_utc)].append(test)
    known = [_session(key, rows, days[key], decisions) for key, rows in groups.items()]
    known.sort(key=lambda session: session.at_utc)
    by_test = {test_id: session for session in known for test_id in session.test_ids}
    by_day = {local_day(session.at_utc): session for session in known}
    for note in notes:  # notes on days without a session are left out
        if (owner := by_test.get(note.test_id or "") or by_day.get(local_day(note.at_utc))) is not None:
            owner.notes.append(note)
    return known, {row.id: row for row in models}


def _key(row: Any) -> str:
    """Return what a version's session is known by."""
    return local_day(row.recorded_utc) if row.origin in ("rig", "joined") else row.recording_id


def _session(key: str, rows: Sequence[Any], tests: Sequence[Any], decisions: dict[str, Approval]) -> Session:
    approvals = [decisions[row.id] for row in rows if row.id in decisions and decisions[row.id].approved]
    approval = max(approvals, key=lambda each: each.id, default=None)
    candidates = [row for row in rows if row.id not in decisions] or rows
    if approval is not None:
        candidates = [row for row in rows if row.id == approval.model_id]
    model = max(candidates, key=lambda row: (row.recorded_utc, row.created_utc))
    # a joined recording belongs to all of its tests
    own_tests = [test for test in tests if test.id == model.test_id] or tests
    charges = [test.charge_uc for test in tests if test.charge_uc is not None]
    return Session(
        key, model.recorded_utc, model, len(rows), approval, own_tests[-1].current_ma if own_tests else None,
        sum(charges) if charges else None, [test.id for test in tests],
    )  # fmt: skip
