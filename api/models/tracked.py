"""Tracked versions of approved models: one row a trial, and what the controller is served of them."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy.orm import defer

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models import stored_model, tracking
from stimrig.api.models.places import Place, differ, place_of
from stimrig.api.models.registry import Served, Versions
from stimrig.api.models.tracking import NOT_FOLLOWED, Bounds, Limits
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Approval, Model, Test, Tracked

log = logging.getLogger("stimrig.tracking")
MOST_EARLIER = 20
"""Approvals before this one from which it is learnt how fast a person changes."""
OF_STEP = ("now", "coming", "moved", "effects", "disturbed_s")
"""Fields of a step that are served with the model."""
SUPERSEDED = "Another model was approved, or this approval ended, before the trial was followed."


@dataclass
class Trial:
    """A trial that is to be followed, with its test's recording."""

    test: Test
    approval: Approval
    """The approval under which the trial was begun."""
    number: int
    """Number among the approval's trials, from 1."""
    earlier: list[list[dict[str, Any]]]
    """The levels of the trials under earlier approvals of this person, oldest first: how fast they change."""
    missed: int
    """Number of trials not followed since the last followed one."""
    since: str
    """Id of the recording that `state` was found from; without one, of the approved model's."""
    state: dict[str, Any] | None = None
    """State after the last followed trial; None: there is none."""
    model_json: str = ""
    """The approved MODEL.json."""
    bounds: Bounds = field(default_factory=dict)
    """Bounds that the approval allows."""
    alarms: Bounds = field(default_factory=dict)
    """Bounds beyond which a new test is requested."""
    problem: str = ""
    """Reason why the approved model cannot be followed; empty where it can."""


class TrackedVersions:
    """The tracked versions of all approvals."""

    def __init__(self, store: Store, clock: Clock, versions: Versions) -> None:
        self.store, self.clock, self.versions = store, clock, versions
        self._earlier: dict[int, list[list[dict[str, Any]]]] = {}

    # ---- a trial -----------------------------------------------------------------------------------------------

    def allowing(self, participant: str) -> Approval | None:
        """The approval that holds, if it allows tracking."""
        approval = self.versions.approved(participant)
        return approval if approval is not None and approval.tracking and Limits(**approval.tracking).allows else None

    def open_trial(self, test_id: str) -> Trial | None:
        """A trial with all that is needed to follow it; None: it has been noted, or was played without an approval."""
        test: Test | None = self.store.get(Test, test_id)
        if test is None or self.store.get(Tracked, test_id) is not None:
            return None
        approval: Approval | None = self.store.get(Approval, test.plan.get("approval_id") or 0)
        if approval is None or approval.tracking is None:
            return None
        rows, model = self.rows(approval.id), self.versions.get(approval.model_id)
        trial = Trial(test, approval, len(rows) + 1, self.earlier(approval), len(rows), model.recording_id)
        for row in rows:
            if row.step is not None:
                trial.state, trial.missed = row.step["state"], len(rows) - row.number
                trial.since = row.recording_id or model.recording_id
        try:
            limits, threshold_us = Limits(**approval.tracking), stored_model.threshold_us(model)
            trial.model_json = stored_model.text(model)
            trial.bounds, trial.alarms = limits.bounds(threshold_us), limits.alarms(threshold_us)
        except ApiError as error:
            trial.problem = error.detail
        return trial

    def earlier(self, approval: Approval) -> list[list[dict[str, Any]]]:
        """Return the levels of the trials under the participant's earlier approvals, oldest first; cached by approval.

        Those of another side, muscle or current say nothing here.
        """
        if approval.id not in self._earlier:
            before = (Approval.participant == approval.participant, Approval.id < approval.id)
            last = self.store.all(Approval, *before, order=Approval.id.desc(), limit=MOST_EARLIER)
            comparable = [previous for previous in last[::-1] if not self.elsewhere(previous, self.places(approval))]
            sessions = [
                [row.step["now"] for row in self.rows(previous.id) if row.step is not None] for previous in comparable
            ]
            self._earlier[approval.id] = [levels for levels in sessions if levels]
        return self._earlier[approval.id]

    def places(self, approval: Approval) -> list[Place]:
        """Return the place of the approved model's test; empty for an uploaded recording."""
        model: Model = self.store.get(Model, approval.model_id)
        return [place_of(test) for test in self.store.all(Test, Test.recording_id == model.recording_id)]

    def elsewhere(self, approval: Approval, places: list[Place]) -> bool:
        """Return whether an approved model is known to be of another side, muscle or current than these places."""
        return any(differ(approved_place, place) for approved_place in self.places(approval) for place in places)

    def text(self, approval: Approval) -> str:
        """The approved MODEL.json. Raises ApiError (500) where it is damaged."""
        return stored_model.text(self.versions.get(approval.model_id))

    def rows(self, approval_id: int) -> list[Tracked]:
        """Return the trials of an approval, oldest first, without the served documents."""
        with self.store.read() as session:
            query = session.query(Tracked).options(defer(Tracked.document)).filter(Tracked.approval_id == approval_id)
            return list(query.order_by(Tracked.number))

    def add_trial(
        self, trial: Trial, result: dict[str, Any], last_sample_unix_s: float | None = None
    ) -> Tracked | None:
        """Store the result of a trial and the document to serve after it.

        Nothing is moved by a trial that is noted already, or whose approval holds no longer.

        Parameters
        ----------
        trial : Trial
            The trial.
        result : dict
            `step` and `model` (`stimrig.api.jobs.tracking_verbs`), or the `reason` why it was not followed.
        last_sample_unix_s : float, optional
            When its last sample came.

        Returns
        -------
        Tracked or None
            The row; None where the trial had been noted.
        """
        approval, step = trial.approval, result.get("step")
        with self.store.write() as session:  # no approval can be made between the check and the write
            if session.get(Tracked, trial.test.id) is not None:
                return None
            holding = self.versions.approved(approval.participant)
            if step is not None and (holding is None or holding.id != approval.id):
                step, result = None, {**result, "reason": SUPERSEDED}
            now = self.clock.utc()
            row = Tracked(test_id=trial.test.id, approval_id=approval.id, number=trial.number, at_utc=now)
            row.participant, row.model_id = approval.participant, approval.model_id
            row.recording_id, row.error_percent = trial.test.recording_id, result.get("error_percent")
            row.outcome, row.reason = NOT_FOLLOWED, result.get("reason", "")
            if step is not None:
                row.outcome, row.reason, row.step = step["outcome"], "", step
                row.ask = tracking.new_test_reason(trial.number, step, trial.alarms)
            elif trial.model_json and row.reason != SUPERSEDED and self._unfollowed_before(approval.id):
                row.ask = tracking.not_followed(trial.number)
            if step is not None or row.ask is not None:
                row.document = body = self._document(trial, row, result.get("model", ""))
                row.etag = hashlib.sha256(body).hexdigest()
                if step is not None and last_sample_unix_s is not None:
                    row.delay_s = round(self.clock.unix_s() - last_sample_unix_s, 3)
            session.add(row)
            detail = {"trial": row.number, "outcome": row.outcome, "reason": row.reason, "etag": row.etag}
            audit.write(session, now, f"test {row.test_id}", "track model", row.model_id, ask=row.ask, **detail)
        return row

    def _document(self, trial: Trial, row: Tracked, model_json: str) -> bytes:
        """Return the document to serve: the tracked model, or the last one within the limits, with `ask` set."""
        approval, step = trial.approval, row.step or {}
        tracking_info = {
            "approved_model_id": approval.model_id, "trial": row.number, "test_id": row.test_id, "at_utc": row.at_utc,
            **{key: step.get(key) for key in OF_STEP}, "limits": approval.tracking, "outcome": row.outcome,
        }  # fmt: skip
        if row.ask is None:
            document = json.loads(model_json)
        else:
            before = self.newest(approval.id)
            document = json.loads(trial.model_json if before is None or before.document is None else before.document)
            none = {"trial": 0, "test_id": None, "at_utc": approval.at_utc, **dict.fromkeys((*OF_STEP, "outcome"))}
            tracking_info = document.get("tracking") or tracking_info | none
        document["model_id"] = f"{approval.model_id}.{approval.id}.{tracking_info['trial']}"
        document["tracking"] = {**tracking_info, "ask": row.ask}
        return json.dumps(document, ensure_ascii=False, allow_nan=False).encode()

    def _unfollowed_before(self, approval_id: int) -> bool:
        """Return whether the last trial could not be followed."""
        rows = self.rows(approval_id)
        return bool(rows) and rows[-1].outcome == NOT_FOLLOWED

    # ---- what is served ----------------------------------------------------------------------------------------

    def newest(self, approval_id: int) -> Tracked | None:
        """Return the newest trial with a served document."""
        conditions = (Tracked.approval_id == approval_id, Tracked.document.is_not(None))
        return self.store.first(Tracked, *conditions, order=Tracked.number.desc())

    def served(self, participant: str) -> Served | None:
        """Return the newest tracked version of the valid approval, else the approved model; None without an approval.

        Raises ApiError: 500 the approved model is damaged.
        """
        approved = self.versions.served(participant)
        if approved is None:
            return None
        row = self.newest(approved.approval_id)
        if row is None or row.document is None:
            return approved
        at_utc = json.loads(row.document)["tracking"]["at_utc"]
        return Served(row.document, f'"{row.etag}"', row.approval_id, at_utc)

    def text_of(self, model_id: str) -> str:
        """MODEL.json of a version, or of one that was tracked from it. Raises ApiError (404, 500)."""
        base, approval_id, number = parts(model_id)
        if number:
            place = (Tracked.model_id == base, Tracked.approval_id == approval_id, Tracked.number == number)
            row = self.store.first(Tracked, *place, Tracked.document.is_not(None), order=Tracked.number)
            if row is not None and row.document is not None:
                return row.document.decode()
        elif base != model_id:  # served before any trial moved it: the version itself, if it was approved
            decision = self.store.get(Approval, approval_id)
            if decision is not None and decision.approved and decision.model_id == base:
                return stored_model.text(self.versions.get(base))
        return stored_model.text(self.versions.get(model_id))

    def version_of(self, model_id: str) -> Model:
        """The version itself, or the one from which it was tracked. Raises ApiError (404)."""
        return self.versions.get(parts(model_id)[0])

    def new_test_reason(self, approval_id: int) -> str | None:
        """Return why a new test is needed; None where none is."""
        row = self.newest(approval_id)
        return row.ask if row else None

    def document(self, participant: str) -> dict[str, Any] | None:
        """The trials of the approval that holds, as clients see them; None where none holds."""
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


def parts(model_id: str) -> tuple[str, int, int]:
    """The version, the approval and the trial of a tracked id; of any other one itself, 0 and 0."""
    base, *places = model_id.rsplit(".", 2)
    if base and len(places) == 2 and all(part.isascii() and part.isdigit() and len(part) < 10 for part in places):
        return base, int(places[0]), int(places[1])
    return model_id, 0, 0
