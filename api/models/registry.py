"""Model versions: immutable, with lineage; approval; and the one the controller gets."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection
from typing import Any, NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import defer

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, require_found
from stimrig.api.models import stored_model
from stimrig.api.models.places import Site, current_of_recording, in_words, site_of, site_of_recording, stored_site
from stimrig.api.models.tracking import Limits
from stimrig.api.store import Store, audit, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Approval, Model, Participant, Recording, Test

COLUMNS = tuple(column.name for column in Model.__table__.columns if column.name not in ("document", "etag", "fit"))
"""Columns of a version that clients see as they are."""
POOR = ("not usable", "unknown")
"""Verdicts that require a reason for an approval."""
AT_ONCE = 16
"""Decisions that are read from the database at a time, the newest first."""
WHAT_TO_WRITE = (
    "Write in a few words why the controller may have this model and who watches it, "
    "for example: only the delay is used today, the engineer stands by."
)


def is_reason(text: str) -> bool:
    """Return whether a text is a usable reason: three different words or more, none a repeated letter."""
    words = {word for word in re.findall(r"[^\W\d_]+", text.casefold()) if len(set(word)) > 1}
    return len(words) >= 3 and sum(map(len, words)) >= 10


class Served(NamedTuple):
    """The document served to the controller, its tag, and since when it holds."""

    body: bytes
    etag: str
    approval_id: int
    at_utc: str


class Versions:
    """The models of all participants."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self.store, self.clock = store, clock

    def add(
        self, model_json: str, participant: str, recording_id: str, by: str, parent_id: str | None = None,
        added_effect: str | None = None, **carried: Any,
    ) -> Model:  # fmt: skip
        """Store a new version; `carried`: the columns `carried` and `carried_from_id`."""
        document, body, now = json.loads(model_json), model_json.encode(), self.clock.utc()
        fit = {
            **stored_model.figures(document),
            **stored_model.quality(document),
            "figures": stored_model.muscle_figures(document),
            "without_evidence": stored_model.without_evidence(document),
        }
        row = Model(
            id=document["model_id"], participant=participant, recording_id=recording_id, parent_id=parent_id,
            added_effect=added_effect, method=document.get("method") or document.get("kind") or "",
            effects=list(stored_model.structure(document)), fit=fit, document=body,
            etag=hashlib.sha256(body).hexdigest(), created_utc=now, created_by=by, **carried,
        )  # fmt: skip
        with self.store.write() as session:
            same = session.get(Model, row.id)
            if same is not None and same.etag == row.etag:
                return same
            if same is not None:
                detail = f"{row.id} is stored already, with other contents. Nothing was overwritten."
                raise ApiError(409, "model-exists", "A model version cannot be changed", detail)
            session.add(row)
            audit.write(session, now, by, "store model", row.id, recording=recording_id, effects=row.effects)
        return row

    def get(self, model_id: str) -> Model:
        """Return a version by its id."""
        fix = "GET /v1/participants/{code}/models lists a participant's."
        return require_found(self.store.get(Model, model_id), "model", model_id, fix)

    def of(self, participant: str, since_utc: str = "") -> list[dict[str, Any]]:
        """Return a participant's versions as clients see them, newest first; with `since_utc` those made since then.

        Three queries, and no model is read whole.
        """
        conditions = (Model.participant == participant, Model.created_utc >= since_utc)
        query = select(Model).options(defer(Model.document)).where(*conditions)
        of_these = Approval.model_id.in_(select(Model.id).where(*conditions))
        decided = select(Approval).where(of_these).order_by(Approval.id)
        with self.store.read() as session:
            rows = list(session.scalars(query.order_by(Model.created_utc.desc())))
            newest = {decision.model_id: decision for decision in session.scalars(decided)}
        holding = self.approved(participant)
        return [_document(row, newest.get(row.id), holding) for row in rows]

    def document(self, row: Model) -> dict[str, Any]:
        """Return a version as clients see it, without the model itself."""
        return _document(row, self.decision(row.id), self.approved(row.participant))

    # ---- descent ---------------------------------------------------------------------------------------------------

    def child_with(self, parent: Model, effects: list[str], with_evidence: Collection[str] = ()) -> Model | None:
        """Return the child of `parent`, of the same recording, that has exactly these effects.

        One that holds any of `with_evidence` without evidence is passed over: it was made before anybody had looked.
        """
        rows = self.store.all(Model, Model.parent_id == parent.id, Model.recording_id == parent.recording_id)
        candidates = [row for row in rows if sorted(row.effects) == sorted(effects)]
        return next((row for row in candidates if set(with_evidence).isdisjoint(row.fit["without_evidence"])), None)

    def lineage(self, model: Model) -> list[Model]:
        """List the versions from the recording's first one to this one, then its newest descendants."""
        path = self.ancestry(model)
        children = self.store.all(Model, Model.recording_id == model.recording_id, order=Model.created_utc)
        while below := [row for row in children if row.parent_id == path[-1].id]:
            path.append(below[-1])
        return path

    def ancestry(self, model: Model) -> list[Model]:
        """List the versions from the recording's first one to this one."""
        rows = {row.id: row for row in self.store.all(Model, Model.recording_id == model.recording_id)}
        path = [model]
        while path[0].parent_id in rows:
            path.insert(0, rows[str(path[0].parent_id)])
        return path

    # ---- decisions -------------------------------------------------------------------------------------------------

    def decide(
        self, model_id: str, approved: bool, by: str, reason: str, tracking: Limits | None = None,
        *, tags: Tags | None = None,
    ) -> int:  # fmt: skip
        """Approve or reject a version; only a person does this. Return the participant's new version.

        `tracking`: how far it may be tracked; None: not at all. `tags`: versions that it is decided on.

        Raises ApiError: 422 it is not usable, and nobody says why the controller may have it all the same; 500 it is
        damaged; 412 the participant was changed since it was shown; 409 it was measured at another site.
        """
        row = self.get(model_id)
        if approved:
            stored_model.whole(row)
            if row.fit["verdict"] in POOR and not is_reason(reason):
                title = "This model is not usable: say why it is approved all the same"
                raise ApiError(422, "reason-needed", title, f"{WHAT_TO_WRITE} Nothing was decided.")
        with self.store.write() as session:
            person = session.get_one(Participant, row.participant)
            locking.check(session, person, tags)
            now, here, (there, _current) = self.clock.utc(), site_of(person), self.measured_at(row)
            if approved and there is not None and there != here:
                words = (
                    f"{row.id} was measured at {in_words(there)}. {person.code} is now stimulated at {in_words(here)}. "
                    "Test anew there, or set the site back on the participant's page. Nothing was decided."
                )
                raise ApiError(409, "other-site", "This model is of another site", words)
            limits = {"tracking": tracking.model_dump()} if approved and tracking else {}
            expires_utc = self.clock.end_of_day_utc() if approved else None
            entry = {"participant": person.code, "reason": reason}
            decision = Approval(
                **entry, **limits, model_id=row.id, approved=approved, by=by, at_utc=now, expires_utc=expires_utc,
                site=list(here),
            )  # fmt: skip
            session.add(decision)
            fit = {name: value for name, value in row.fit.items() if name != "figures"}
            action = "approve" if approved else "reject"
            locking.write(session, person, now, by, action, row.id, **entry, shown=fit, **limits)
            return person.version

    def measured_at(self, row: Model) -> tuple[Site | None, float | None]:
        """Return the site and current (mA) of a version's recording; None: unknown."""
        recording: Recording = self.store.get(Recording, row.recording_id)
        test: Test | None = self.store.first(Test, Test.recording_id == recording.id)
        return site_of_recording(recording, test), current_of_recording(recording, test)

    def why_not_joined(self, row: Model) -> str:
        """Say why no further recording can be joined to that of a version; empty where one can."""
        if self.measured_at(row)[1] is not None:
            return ""
        fix = "Take a model of the rig's own recordings (HDF5), of one current."
        return f"{row.recording_id} does not say with what current it was made. {fix}"

    def decision(self, model_id: str) -> Approval | None:
        """Return the newest decision on a version."""
        return self.store.first(Approval, Approval.model_id == model_id, order=Approval.id.desc())

    # ---- what holds ------------------------------------------------------------------------------------------------

    def approved(self, participant: str) -> Approval | None:
        """Return the participant's valid approval of today."""
        return self.all_approved([participant]).get(participant)

    def all_approved(self, participants: Collection[str]) -> dict[str, Approval]:
        """Return the valid approvals of many participants, in one query."""
        now, approvals = self.clock.utc(), self._last_approvals(participants)
        return {code: row for code, row in approvals.items() if (row.expires_utc or "") > now}

    def last_approved(self, participant: str) -> Model | None:
        """Return the version approved last and not rejected since, whether or not the approval has expired."""
        last = self._last_approvals([participant]).get(participant)
        return None if last is None else self.get(last.model_id)

    def _last_approvals(self, participants: Collection[str]) -> dict[str, Approval]:
        query = select(Approval).where(Approval.participant.in_(participants)).order_by(Approval.id.desc())
        rejected: set[str] = set()
        newest: dict[str, Approval] = {}
        with self.store.read() as session:
            of = session.scalars(select(Participant).where(Participant.code.in_(participants)))
            sites = {row.code: site_of(row) for row in of}
            for decision in session.scalars(query.execution_options(yield_per=AT_ONCE)):
                if len(newest) == len(sites):
                    break  # avoids reading years of decisions
                if not decision.approved:
                    rejected.add(decision.model_id)
                elif decision.model_id not in rejected and stored_site(decision.site) == sites[decision.participant]:
                    newest.setdefault(decision.participant, decision)
        return newest

    def all_approved_ones(self, participant: str) -> list[Model]:
        """List the versions approved and not rejected since, oldest first, the last one of each recording."""
        decided = self.store.all(Approval, Approval.participant == participant, order=Approval.id)
        newest = {decision.model_id: decision for decision in decided}
        in_order = sorted(newest.values(), key=lambda decision: decision.id, reverse=True)
        rows = [self.get(decision.model_id) for decision in in_order if decision.approved]
        return list({row.recording_id: row for row in rows[::-1]}.values())

    def served(self, participant: str) -> Served | None:
        """Return the model served to the controller; None without an approval. Raises ApiError (500): damaged."""
        approval = self.approved(participant)
        if approval is None:
            return None
        row = self.get(approval.model_id)
        return Served(stored_model.whole(row), f'"{row.etag}"', approval.id, approval.at_utc)

    def recruitment(self, participant: str) -> dict[str, list[float]] | None:
        """Return the recruitment curve of the approved model; None where nothing is approved, or it is damaged."""
        try:
            served = self.served(participant)
        except ApiError:  # the page of the model says so
            return None
        curve = json.loads(served.body)["recruitment"] if served else None
        return curve and {name: curve[name] for name in ("pulse_width_us", "torque_nm")}


def _document(row: Model, decision: Approval | None, holding: Approval | None) -> dict[str, Any]:
    return {
        "model_id": row.id,
        **{name: getattr(row, name) for name in COLUMNS},
        **row.fit,
        "decision": None if decision is None else "approved" if decision.approved else "rejected",
        "decided_by": decision.by if decision else None,
        "decided_utc": decision.at_utc if decision else None,
        "decision_reason": decision.reason if decision else None,
        "expires_utc": decision.expires_utc if decision else None,
        "tracking": decision.tracking if decision else None,
        "served": holding is not None and holding.model_id == row.id,
    }
