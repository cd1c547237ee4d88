"""Participants: codes and a profile of limits, no names; their site; the list of all.

Models, approvals and keys belong to one site.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError, require_found
from stimrig.api.models.places import in_words, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.services.context import Context, under_limits_lock
from stimrig.api.services.decisions import Change, Decision
from stimrig.api.sessions import profiles
from stimrig.api.sessions.requests import MuscleIn, ParticipantIn
from stimrig.api.store import Store, locking
from stimrig.api.store.tables import Approval, Model, Participant, Test


def create(context: Context, body: ParticipantIn, by: str) -> Participant:
    """Add a participant; 409 where the code is taken, 422 where this rig would refuse its limits."""
    now = context.clock.utc()
    profile = body.profile.model_dump(exclude_none=True)
    if "profile" in body.model_fields_set:
        check_limits(context, profile, profile)
        profile = add_calibration_time(context, profile)
    with context.store.write() as session:
        if session.get(Participant, body.code) is not None:
            raise ApiError(409, "exists", "The code is taken", f"Participant {body.code!r} exists. Take another code.")
        row = Participant(code=body.code, created_utc=now, created_by=by)
        row.profile = profile
        row.side, row.muscle, row.placement = body.side, body.muscle, body.placement
        site = {"side": row.side, "muscle": row.muscle, "placement": row.placement}
        locking.write(session, row, now, by, "create participant", body.code, profile=row.profile, **site)
        session.add(row)
    return row


def find(context: Context, code: str) -> Participant:
    """Return a participant by its code; 404 where there is none."""
    return require_found(context.store.get(Participant, code), "participant", code, "POST /v1/participants makes one.")


def within(session: Session, code: str) -> Participant:
    """Return a participant within the caller's transaction; 404 where there is none."""
    return require_found(session.get(Participant, code), "participant", code)


@contextmanager
def deciding(context: Context, code: str, decision: Decision) -> Iterator[tuple[Session, Participant]]:
    """Open the transaction of a decision. Raises ApiError: 404 no such participant; 412 changed since it was seen."""
    with context.store.write() as session:
        row = within(session, code)
        locking.check(session, row, decision.tags)
        yield session, row


@under_limits_lock
def change_profile(context: Context, code: str, limits: dict[str, Any], decision: Decision) -> Participant:
    """Change the given limits of a participant; the others stay.

    Raises ApiError: as `deciding`; 422 beyond what the rig takes, or the first ones are not whole; 409 the calibration
    would be lost, or on a page a limit jumps, and that was not confirmed.
    """
    with deciding(context, code, decision) as (session, row):
        before = row.profile
        check_limits(context, before, limits)
        profile, voids = profiles.changed(before, add_calibration_time(context, limits))
        warnings = profiles.jumps(before, profile) if decision.on_page else []
        if voids:
            required = context.rig.status is None or context.rig.status.require_calibration is not False
            then = " Until the participant is calibrated anew, no test starts." if required else ""
            warnings.append(f"The calibration is lost with it: {voids}.{then}")
        if warnings:
            changes = limit_changes(before, profile)
            button = f"Yes, set {', '.join(change.now for change in changes[: len(profiles.LIMITS)])}"
            refusal = "voids-calibration" if voids else "confirm"
            title = f"Set these limits for {code}?"
            decision.require_confirmation(row.version, title, button, changes, warnings, refusal)
        if profile != before:
            row.profile = profile
            now = context.clock.utc()
            locking.write(session, row, now, decision.by, "set profile", code, profile=profile, voids=voids)
    return row


def limit_changes(before: dict[str, Any], profile: dict[str, Any]) -> list[Change]:
    """List all limits, each with its value before."""
    changes = [
        Change(limit.words.capitalize(), f"{profile[name]:g} {limit.unit}",
               f"{before.get(name, profile[name]):g} {limit.unit}")
        for name, limit in profiles.LIMITS.items()
    ]  # fmt: skip
    if (range_rad := profiles.range_of(profile)) is not None:
        was_rad = profiles.range_of(before)
        was = profiles.range_words(was_rad) if was_rad else ""
        changes.append(Change("Joint angles", profiles.range_words(range_rad), was))
    return changes


def check_limits(context: Context, profile: dict[str, Any], limits: dict[str, Any]) -> None:
    """Refuse first limits that are not whole, and what this rig would refuse."""
    if lacking := [name for name in profiles.LIMITS if {**profile, **limits}.get(name) is None]:
        raise ApiError(422, "invalid-input", "Some limits are missing", f"Send {', '.join(lacking)}, too.")
    status = context.rig.status
    problems = profiles.outside(limits, profile, status.limits if status else {})
    if problems := problems | profiles.range_outside(limits, status.angle.range_rad if status else None):
        errors = [{"field": name, "detail": words} for name, words in problems.items()]
        detail = "; ".join(f"{name}: {words}" for name, words in problems.items()) + ". Nothing was changed."
        raise ApiError(422, "invalid-input", "These limits cannot be used", detail, errors=errors)


def add_calibration_time(context: Context, limits: dict[str, Any]) -> dict[str, Any]:
    """Add the time of the sensor's calibration to a range of angles, which is void after the next calibration."""
    if limits.get(profiles.RANGE) is None:
        return limits
    calibration = context.rig.status.angle.calibration if context.rig.status else None
    return {**limits, profiles.SET_AT: calibration.set_at_utc if calibration else None}


def effect_on_open_work(context: Context, code: str) -> str:
    """Say what changed limits mean for the participant's running test or open calibration; empty without one."""
    current, status = context.runner.current, context.rig.status
    if current is not None and current.participant == code:
        return (
            "The test that runs keeps the limits that it was begun with; changed ones hold from the next test on. "
            "Less current now: press stop."
        )
    if status is not None and status.calibration is not None and status.calibration.participant == code:
        return (
            "A calibration is open. Once limits are changed it sends no further train and gives no profile: discard it "
            "and begin anew."
        )
    return ""


@under_limits_lock
def change_site(context: Context, code: str, body: MuscleIn, decision: Decision) -> Participant:
    """Change the stimulated site, which voids the calibration, models and keys of the site before.

    Raises ApiError: as `deciding`; 409 a test or calibration of it is under way, or the calibration would be lost, or
    on a page the approved model, and that was not confirmed.
    """
    refuse_busy(context, code)
    has_model = decision.on_page and context.versions.approved(code) is not None
    with deciding(context, code, decision) as (session, row):
        here, there = site_of(row), (body.side, body.muscle, body.placement)
        if here == there:
            return row
        moves = any(before is not None and before != after for before, after in zip(here, there, strict=True))
        lost = moves and any(row.profile.get(name) is not None for name in profiles.CALIBRATION_FIELDS)
        before, after = in_words(here), in_words(there)
        warnings = []
        if lost:
            warnings.append(f"The calibration is lost with it: its thresholds were found at {before}.")
        if has_model:
            warnings.append(f"The approved model and its keys are of {before}. Here there is none.")
        if warnings:
            title, refusal = f"Change side and muscle of {code}?", "voids-calibration" if lost else "confirm"
            changes = [Change("Side and muscle", after, before)]
            decision.require_confirmation(row.version, title, f"Yes, it is {after}", changes, warnings, refusal)
        if lost:
            row.profile = {**row.profile, **dict.fromkeys(profiles.CALIBRATION_FIELDS)}
        row.side, row.muscle, row.placement = there
        details = {**body.model_dump(), "voids_calibration": lost}
        locking.write(session, row, context.clock.utc(), decision.by, "set muscle", code, **details)
    return row


def refuse_busy(context: Context, code: str) -> None:
    """409 while the rig works with this participant."""
    current, status = context.runner.current, context.rig.status
    calibration = status.calibration if status else None
    if current is not None and current.participant == code:
        detail = f"{current.test_id} of {code} runs. Wait for its end, or stop it; then do it again."
        raise ApiError(409, "participant-busy", "A test of this participant runs", detail)
    if calibration is not None and calibration.participant == code:
        detail = f"A calibration of {code} is open. Finish or discard it; then do it again."
        raise ApiError(409, "participant-busy", "A calibration of this participant is open", detail)


@dataclass(frozen=True)
class Listed:
    """A participant in the list: its last test, its newest model, and what the controller gets."""

    participant: Participant
    last: Any
    newest: dict[str, Any] | None
    approved: Approval | None


def matching(store: Store, q: str = "") -> list[Participant]:
    """Participants whose code holds `q`, in any case; who was last tested, or made, comes first."""
    last = select(Test.participant, func.max(Test.requested_utc).label("utc")).group_by(Test.participant).subquery()
    query = select(Participant).outerjoin(last, last.c.participant == Participant.code)
    if q.strip():
        query = query.where(Participant.code.icontains(q.strip(), autoescape=True))
    newest_first = func.coalesce(last.c.utc, Participant.created_utc).desc()
    with store.read() as session:
        return list(session.scalars(query.order_by(newest_first, Participant.code)))


def list_rows(store: Store, versions: Versions, participants: list[Participant]) -> list[Listed]:
    """Return the list's row of each participant, without reading plans of tests or models."""
    codes = [row.code for row in participants]
    tests = _newest_rows(store, Test, Test.requested_utc, codes, Test.state, Test.requested_utc)
    models = _newest_rows(store, Model, Model.created_utc, codes, Model.fit)
    approved = versions.all_approved(codes)
    rows = []
    for row in participants:
        model = models.get(row.code)
        newest = {"id": model.id, **model.fit} if model else None
        rows.append(Listed(row, tests.get(row.code), newest, approved.get(row.code)))
    return rows


def _newest_rows(store: Store, table: Any, at_utc: Any, codes: list[str], *columns: Any) -> dict[str, Any]:
    """The newest row of each participant in a table, by its time: these columns of it."""
    newest = select(table.participant, func.max(at_utc).label("utc")).where(table.participant.in_(codes))
    last = newest.group_by(table.participant).subquery()
    query = select(table.id, table.participant, *columns)
    query = query.join(last, (table.participant == last.c.participant) & (at_utc == last.c.utc))
    with store.read() as session:
        return {row.participant: row for row in session.execute(query)}
