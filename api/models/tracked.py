"""Tracked versions of approved models: one row a trial, and what the controller is served of them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import defer

from stimrig.api.clock import Clock
from stimrig.api.models import stored_model, tracking
from stimrig.api.models.places import Place, differ, place_of
from stimrig.api.models.registry import Served, Versions
from stimrig.api.models.tracking import NOT_FOLLOWED, Limits
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Approval, Model, Test, Tracked

MOST_EARLIER = 20
"""Approvals before this one from which it is learnt how fast a person changes."""
OF_STEP = ("now", "coming", "moved", "effects", "disturbed_s", "outcome")
"""Fields of a step that are served with the model."""
SUPERSEDED = "Another model was approved, or this approval ended, before the trial was followed."


@dataclass(frozen=True)
class Trial:
    """A trial that is to be followed."""

    test: Test
    approval: Approval  # under which it was begun
    model: Model  # the approved one
    before: list[Tracked]  # the approval's trials before it, oldest first

    @property
    def last(self) -> Tracked | None:
        """The last trial before it that was followed."""
        return next((row for row in reversed(self.before) if row.step is not None), None)

    @property
    def limits(self) -> Limits:
        """Limits of tracking the model."""
        return Limits(**(self.approval.tracking or {}))


class TrackedVersions:
    """The tracked versions of all approvals."""

    def __init__(self, store: Store, clock: Clock, versions: Versions) -> None:
        self.store, self.clock, self.versions = store, clock, versions
        self._earlier: dict[int, list[list[dict[str, Any]]]] = {}

    # ---- a trial -----------------------------------------------------------------------------------------------

    def allowing(self, participant: str) -> Approval | None:
        """Return the approval that holds, if it allows tracking."""
        approval = self.versions.approved(participant)
        return approval if approval is not None and approval.tracking and Limits(**approval.tracking).allows else None

    def open_trial(self, test_id: str) -> Trial | None:
        """Return a trial that is to be followed; None: it was noted, or was played without an approval."""
        test: Test | None = self.store.get(Test, test_id)
        if test is None or self.store.get(Tracked, test_id) is not None:
            return None
        approval: Approval | None = self.store.get(Approval, test.plan.get("approval_id") or 0)
        if approval is None or approval.tracking is None:
            return None
        return Trial(test, approval, self.versions.get(approval.model_id), self.rows(approval.id))

    def arguments(self, trial: Trial) -> dict[str, Any]:
        """Return what the worker follows a trial with. Raises ApiError (500): the approved model is damaged."""
        last = trial.last
        return {
            "model_json": stored_model.text(trial.model),
            "bounds": trial.limits.bounds(stored_model.threshold_us(trial.model)),
            "state": last.step["state"] if last and last.step else None,
            "missed": len(trial.before) - (last.number if last else 0),
            "earlier": self.earlier(trial.approval),
            "reference_torque_nm": trial.test.plan.get("reference_torque_nm"),
        }

    def earlier(self, approval: Approval) -> list[list[dict[str, Any]]]:
        """Return the levels of the trials under the participant's earlier approvals, oldest first; cached by approval.

        Those of another side, muscle or current say nothing here.
        """
        if approval.id not in self._earlier:
            before = (Approval.participant == approval.participant, Approval.id < approval.id)
            last = self.store.all(Approval, *before, order=Approval.id.desc(), limit=MOST_EARLIER)
            here = self.places(approval)
            comparable = [self.rows(previous.id) for previous in last[::-1] if not self.elsewhere(previous, here)]
            sessions = [[row.step["now"] for row in rows if row.step is not None] for rows in comparable]
            self._earlier[approval.id] = [levels for levels in sessions if levels]
        return self._earlier[approval.id]

    def places(self, approval: Approval) -> list[Place]:
        """Return the place of the approved model's test; empty for an uploaded recording."""
        model: Model = self.store.get(Model, approval.model_id)
        return [place_of(test) for test in self.store.all(Test, Test.recording_id == model.recording_id)]

    def elsewhere(self, approval: Approval, places: list[Place]) -> bool:
        """Return whether an approved model is known to be of another side, muscle or current than these places."""
        return any(differ(approved_place, place) for approved_place in self.places(approval) for place in places)

    def rows(self, approval_id: int) -> list[Tracked]:
        """Return the trials of an approval, oldest first, without the served documents."""
        with self.store.read() as session:
            query = session.query(Tracked).options(defer(Tracked.document)).filter(Tracked.approval_id == approval_id)
            return list(query.order_by(Tracked.number))

    def add_trial(
        self, trial: Trial, result: dict[str, Any], last_sample_unix_s: float | None = None
    ) -> Tracked | None:
        """Store the result of a trial, and the model where it has moved it; None where the trial had been noted.

        A trial whose approval holds no longer moves nothing.

        `result`: `step` and `model` (`stimrig.api.jobs.tracking.track`), or the `reason` why it was not followed;
        `last_sample_unix_s`: when its last sample came.
        """
        approval, step, number = trial.approval, result.get("step"), len(trial.before) + 1
        with self.store.write() as session:  # no approval can be made between the check and the write
            if session.get(Tracked, trial.test.id) is not None:
                return None
            holding, now = self.versions.approved(approval.participant), self.clock.utc()
            reason = result.get("reason", "")
            if step is not None and (holding is None or holding.id != approval.id):
                step, reason = None, SUPERSEDED
            row = Tracked(
                test_id=trial.test.id, approval_id=approval.id, participant=approval.participant,
                model_id=approval.model_id, recording_id=trial.test.recording_id, number=number, at_utc=now,
                outcome=step["outcome"] if step else NOT_FOLLOWED, reason=reason, step=step,
                error_percent=result.get("error_percent"),
            )  # fmt: skip
            if step is not None:
                alarms = trial.limits.alarms(stored_model.threshold_us(trial.model))
                row.ask = tracking.new_test_reason(number, step, alarms)
                if last_sample_unix_s is not None:
                    row.delay_s = round(self.clock.unix_s() - last_sample_unix_s, 3)
            elif reason != SUPERSEDED and trial.before and trial.before[-1].outcome == NOT_FOLLOWED:
                row.ask = tracking.not_followed(number)
            if step is not None and row.ask is None:
                body = _body(json.loads(result["model"]), approval, number, row.test_id, now, step)
                row.document, row.etag = body, hashlib.sha256(body).hexdigest()
            session.add(row)
            detail = {"trial": number, "outcome": row.outcome, "reason": reason, "etag": row.etag, "ask": row.ask}
            audit.write(session, now, f"test {row.test_id}", "track model", row.model_id, **detail)
        return row

    # ---- what is served ----------------------------------------------------------------------------------------

    def served(self, participant: str) -> Served | None:
        """Return the newest tracked version of the valid approval, else the approved model; None without an approval.

        Where a person has to look first, it says so in `ask`, and is the last version within the limits.

        Raises ApiError: 500 the approved model is damaged.
        """
        approved = self.versions.served(participant)
        if approved is None:
            return None
        moved = (Tracked.approval_id == approved.approval_id, Tracked.document.is_not(None))
        row: Tracked | None = self.store.first(Tracked, *moved, order=Tracked.number.desc())
        reason, body = self.new_test_reason(approved.approval_id), row.document if row else None
        if body is None and reason is None:
            return approved
        if body is None:
            approval: Approval = self.store.get(Approval, approved.approval_id)
            body = _body(json.loads(approved.body), approval, 0, None, approved.at_utc, {})
        document = json.loads(body)
        document["tracking"]["ask"] = reason
        body = _dumped(document)
        etag = f'"{hashlib.sha256(body).hexdigest()}"'
        return Served(body, etag, approved.approval_id, document["tracking"]["at_utc"])

    def find(self, model_id: str) -> tuple[Model, str]:
        """Return a version and its MODEL.json: of one that was tracked, `VERSION.APPROVAL.TRIAL`, the tracked one.

        Raises ApiError (404, 500).
        """
        base, *places = model_id.rsplit(".", 2)
        if len(places) == 2 and all(part.isascii() and part.isdigit() and len(part) < 10 for part in places):
            approval_id, number = map(int, places)
            conditions = (Tracked.model_id == base, Tracked.approval_id == approval_id, Tracked.number == number)
            row: Tracked | None = self.store.first(Tracked, *conditions)
            if row is not None and row.document is not None:
                return self.versions.get(base), row.document.decode()
            decision: Approval | None = self.store.get(Approval, approval_id)
            if number == 0 and decision is not None and decision.approved and decision.model_id == base:
                model_id = base  # served before any trial moved it: the version itself
        version = self.versions.get(model_id)
        return version, stored_model.text(version)

    def new_test_reason(self, approval_id: int) -> str | None:
        """Return why a new test is needed; None where none is."""
        rows = self.rows(approval_id)
        return next((row.ask for row in reversed(rows) if row.step is not None or row.ask is not None), None)

    def document(self, participant: str) -> dict[str, Any] | None:
        """Return the trials of the approval that holds, as clients see them; None where none holds."""
        approval, served = self.versions.approved(participant), self.served(participant)
        if approval is None or served is None:
            return None
        return {
            "participant": participant,
            "approved_model_id": approval.model_id,
            "approved_utc": approval.at_utc,
            "limits": approval.tracking,
            "threshold_us": stored_model.threshold_us(self.versions.get(approval.model_id)),
            "served_utc": served.at_utc,
            "served_trial": json.loads(served.body).get("tracking", {}).get("trial", 0),
            "etag": served.etag,
            "ask": self.new_test_reason(approval.id),
            "trials": [trial_document(row) for row in self.rows(approval.id)],
        }


def trial_document(row: Tracked) -> dict[str, Any]:
    """Return a trial's document for clients."""
    step = row.step or {}
    step_fields = ("now", "coming", "effects", "error_nm", "expected_error_nm", "disturbed_s", "distance")
    row_fields = ("number", "test_id", "recording_id", "at_utc", "outcome", "reason", "ask", "error_percent", "delay_s")
    return {**{name: getattr(row, name) for name in row_fields}, **{name: step.get(name) for name in step_fields}}


def _body(
    document: dict[str, Any], approval: Approval, trial: int, test_id: str | None, at_utc: str, step: dict[str, Any]
) -> bytes:
    """Return a tracked MODEL.json: with an id of its own, and the key `tracking`."""
    document["model_id"] = f"{approval.model_id}.{approval.id}.{trial}"
    document["tracking"] = {
        "approved_model_id": approval.model_id, "trial": trial, "test_id": test_id, "at_utc": at_utc,
        **{name: step.get(name) for name in OF_STEP}, "limits": approval.tracking, "ask": None,
    }  # fmt: skip
    return _dumped(document)


def _dumped(document: dict[str, Any]) -> bytes:
    return json.dumps(document, ensure_ascii=False, allow_nan=False).encode()
