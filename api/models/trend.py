"""A participant's sessions over time: one model for each, with its figures, conditions, notes and approval.

A session is a day in the clinic: all that the rig recorded on that day, where the service stands. A recording of
another tool is a session by itself. Of all versions of a session one is shown: the approved one; where none is
approved, the newest one of its newest recording.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Row, select

from stimrig.api.clock import local_day
from stimrig.api.models import changes, stored_model
from stimrig.api.store import Store
from stimrig.api.store.tables import Approval, Model, Note, Recording, Test

CONDITIONS = ("electrodes", "side", "posture")
"""Kinds of notes that put a comparison in doubt where they differ."""
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
    test_ids: tuple[str, ...]
    notes: list[Note] = field(default_factory=list)

    def state(self) -> changes.State:
        """Return what is compared of it."""
        figures = self.model.fit.get("figures") or {}
        texts = {kind: " · ".join(note.text for note in self.notes if note.kind == kind) for kind in CONDITIONS}
        structure = changes.structure_of(self.model.effects, figures)
        noted = tuple((kind, text) for kind, text in texts.items() if text)
        return changes.State(figures, self.model.method, structure, self.current_ma, noted)

    def document(self) -> dict[str, Any]:
        """Return it as REST answers it."""
        fit, approval = self.model.fit, self.approval
        figures = {name: {**figure, "uncertainty": changes.uncertainty(name, figure)}
                   for name, figure in (fit.get("figures") or {}).items()}  # fmt: skip
        others = {**fit, "charge_uc": self.charge_uc, "current_ma": self.current_ma}
        figures |= {name: _certain(others.get(name), unit) for name, unit in OTHER_UNITS.items()}
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
            "notes": [{name: getattr(note, name) for name in NOTE_FIELDS} for note in self.notes],
        }

    def page_document(self) -> dict[str, Any]:
        """Return `document` as pages show it: at the model's time, with one fit, and on which pulses it was found."""
        document = self.document()
        figures = {name: figure for name, figure in document["figures"].items() if not name.endswith("fit_percent")}
        fit = stored_model.followed(self.model.fit)
        figures["follows_percent"] = {**_certain(fit.percent, "%"), "where": fit.where}
        figures["charge_uc"]["where"] = (
            f"charge of one phase, over all pulses of that day's tests ({len(self.test_ids)}), stopped ones, too"
        )
        evidence = self.model.fit.get("without_evidence") or []
        return {**document, "at_utc": self.model.created_utc, "without_evidence": evidence, "figures": figures}


def _certain(value: float | None, unit: str) -> dict[str, Any]:
    return {"value": value, "sd": None, "uncertainty": None, "unit": unit}


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


class Trend:
    """Reads sessions."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def sessions(self, participant: str) -> list[Session]:
        """Return a participant's sessions, the oldest first."""
        return self._read(participant)[0]

    def for_models(self, participant: str, model_ids: Sequence[str]) -> list[Session]:
        """Return for each model the session in which its recording was made, with this model for it."""
        sessions, models = self._read(participant)
        return [_with_model(sessions, models[model_id]) for model_id in model_ids]

    def changes_to(self, model: Model) -> dict[str, Any] | None:
        """Return what changed to a model from the last approved session before it; None where there is none."""
        sessions, models = self._read(model.participant)
        now = _with_model(sessions, models[model.id])
        earlier = [session for session in sessions if session.at_utc < now.at_utc and session.key != now.key]
        approved = [session for session in earlier if session.approval is not None]
        return changes_between(approved[-1], now) if approved else None

    def _read(self, participant: str) -> tuple[list[Session], dict[str, Any]]:
        """Return the sessions, and all models by their ids without their documents, which are long."""
        columns = (
            Model.id, Model.recording_id, Model.method, Model.effects, Model.fit, Model.created_utc,
            Recording.origin, Recording.created_utc.label("recorded_utc"), Recording.test_id,
        )  # fmt: skip
        test_columns = (
            Test.id, Test.requested_utc, Test.plan["profile"]["current_ma"].as_float().label("current_ma"),
            Test.summary["charge_uc"].as_float().label("charge_uc"),
        )  # fmt: skip
        with self.store.read() as session:
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
        sessions = [_session(key, rows, days[key], decisions) for key, rows in groups.items()]
        sessions.sort(key=lambda session: session.at_utc)
        by_test = {test_id: session for session in sessions for test_id in session.test_ids}
        by_day = {local_day(session.at_utc): session for session in sessions}
        for note in notes:  # notes on days without a session are left out
            if (owner := by_test.get(note.test_id or "") or by_day.get(local_day(note.at_utc))) is not None:
                owner.notes.append(note)
        return sessions, {row.id: row for row in models}


def _with_model(sessions: Sequence[Session], model: Any) -> Session:
    return replace(next(session for session in sessions if session.key == _key(model)), model=model)


def _key(row: Any) -> str:
    """Return what a version's session is known by."""
    return local_day(row.recorded_utc) if row.origin in ("rig", "joined") else row.recording_id


def _session(
    key: str, rows: Sequence[Row[Any]], tests: Sequence[Row[Any]], decisions: Mapping[str, Approval]
) -> Session:
    decided = {row.id: decisions[row.id] for row in rows if row.id in decisions}
    approval = max((each for each in decided.values() if each.approved), key=lambda each: each.id, default=None)
    candidates = [row for row in rows if row.id not in decided or decided[row.id].approved] or rows
    if approval is not None:
        candidates = [row for row in rows if row.id == approval.model_id]
    model = max(candidates, key=lambda row: (row.recorded_utc, row.created_utc))
    # a joined recording belongs to all of its tests
    own_tests = [test for test in tests if test.id == model.test_id] or tests
    charges = [test.charge_uc for test in tests if test.charge_uc is not None]
    return Session(
        key, model.recorded_utc, model, len(rows), approval, own_tests[-1].current_ma if own_tests else None,
        sum(charges) if charges else None, tuple(test.id for test in tests),
    )  # fmt: skip
