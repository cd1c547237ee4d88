"""Participants: codes and a profile of limits, no names."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from sqlalchemy.orm import Session

from stimrig.api.clock import local_day
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.sessions import directory, profiles
from stimrig.api.sessions.requests import ParticipantIn, ProfileIn
from stimrig.api.store import audit, seen
from stimrig.api.store.holds import LIMITS_TURN
from stimrig.api.store.seen import Seen
from stimrig.api.store.tables import Participant, Test
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, Tester
from stimrig.api.web.responses.base import answers
from stimrig.api.web.responses.participants import ChangedOut, ParticipantOut
from stimrig.api.web.responses.rig import TestOut
from stimrig.rig.messages import Status

router = APIRouter(prefix="/v1/participants", tags=["participants"], responses=PROBLEM)


def create(context: Context, body: ParticipantIn, by: str) -> Participant:
    """A new participant; 409 where the code is taken, 422 where this rig would refuse its limits."""
    now = context.clock.utc()
    profile = body.profile.model_dump(exclude_none=True)
    if "profile" in body.model_fields_set:
        check_asked(context, profile, profile)
        profile = with_calibration(context, profile)
    with context.store.write() as session:
        if session.get(Participant, body.code) is not None:
            raise ApiError(409, "exists", "The code is taken", f"Participant {body.code!r} exists. Take another code.")
        row = Participant(code=body.code, profile=profile, created_utc=now, created_by=by)
        row.side, row.muscle, row.placement = body.side, body.muscle, body.placement
        session.add(row)
        session.flush()
        said = {"side": row.side, "muscle": row.muscle, "placement": row.placement}
        audit.write(session, now, by, "create participant", body.code, profile=row.profile, **said)
    return row


def find(context: Context, code: str) -> Participant:
    """A participant by its code; 404 where there is none."""
    row = context.store.get(Participant, code)
    if row is None:
        raise NotFoundError("participant", code, "POST /v1/participants makes one.")
    return row


def within(session: Session, code: str) -> Participant:
    """The same in a transaction that changes it."""
    row = session.get(Participant, code)
    if row is None:
        raise NotFoundError("participant", code)
    return row


async def change_profile(
    context: Context, code: str, asked: dict[str, Any], by: str, may_void: bool = False
) -> tuple[Participant, Seen]:  # fmt: skip
    """New limits for a participant: those that are asked for, the rest stays; and the place in the trail.

    Raises
    ------
    ApiError
        404 no such participant; 422 beyond what the rig takes, or the first ones are not whole; 409 changed meanwhile,
        or the calibration would be lost, and that was not allowed.
    """
    async with context.holds.turn(LIMITS_TURN):
        return await asyncio.to_thread(_change, context, code, asked, by, may_void)


def _change(
    context: Context, code: str, asked: dict[str, Any], by: str, may_void: bool
) -> tuple[Participant, Seen]:  # fmt: skip
    with context.store.write() as session:
        row = within(session, code)
        poses = [] if asked.get(profiles.RANGE) is None else [seen.poses()]
        seen.check(session, seen.participant(code), *poses)
        check_asked(context, row.profile, asked)
        profile, voids = profiles.changed(row.profile, with_calibration(context, asked))
        if voids and not may_void:
            detail = (
                f"{voids[0].upper()}{voids[1:]}. To set it and make the calibration invalid: ?void_calibration=true."
            )
            raise ApiError(409, "voids-calibration", "This would make the calibration invalid", detail)
        if profile != row.profile:
            row.profile = profile
            audit.write(session, context.clock.utc(), by, "set profile", code, profile=profile, voids=voids)
        shown = seen.shown.get()
        if shown is not None and seen.since(session, shown, seen.decisions(code), seen.poses()):
            return row, shown  # limits are answered, not what was decided on models, nor where the angle's zero is
        return row, seen.newest(session, local_day(context.clock.utc()))


def check_asked(context: Context, profile: dict[str, Any], asked: dict[str, Any]) -> None:
    """Refuse first limits that are not whole, and what this rig would refuse."""
    if lacking := [name for name in profiles.LIMITS if {**profile, **asked}.get(name) is None]:
        raise ApiError(422, "invalid-input", "Some limits are missing", f"Send {', '.join(lacking)}, too.")
    status = context.rig.status
    found = profiles.outside(asked, profile, status.limits if status else {})
    if found := found | profiles.range_outside(asked, status.angle.range_rad if status else None):
        errors = [{"field": name, "detail": words} for name, words in found.items()]
        detail = "; ".join(f"{name}: {words}" for name, words in found.items()) + ". Nothing was changed."
        raise ApiError(422, "invalid-input", "These limits cannot be used", detail, errors=errors)


def with_calibration(context: Context, asked: dict[str, Any]) -> dict[str, Any]:
    """What is asked for; a range of joint angles holds as long as the angle sensor's calibration of now."""
    if asked.get(profiles.RANGE) is None:
        return asked
    return {**asked, profiles.SET_AT: calibrated_utc(context.rig.status)}


def calibrated_utc(status: Status | None) -> str | None:
    """When the rig's angle sensor was calibrated; None: by nobody."""
    calibration = status.angle.calibration if status else None
    return calibration.set_at_utc if calibration else None


def meanwhile(context: Context, code: str) -> str:
    """What a change of this participant's limits means for what goes on; empty where nothing does."""
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


@router.post("", status_code=201, **answers(ParticipantOut, 201, "made; see `Location`"))
def make_participant(context: Ctx, who: Tester, body: ParticipantIn, response: Response) -> dict[str, Any]:
    """Make a participant: a code, never a name."""
    row = create(context, body, who.name)
    response.headers["Location"] = f"/v1/participants/{row.code}"
    return row.as_dict()


@router.get("", **answers(list[ParticipantOut]))
def list_participants(
    context: Ctx,
    _who: Tester,
    q: Annotated[str, Query(max_length=80, description="a part of the code, in any case")] = "",
    archived: Annotated[bool | None, Query(description="only those that are archived, or that are not")] = None,
) -> list[dict[str, Any]]:
    """All participants, or those that are looked for; who was last tested, or made, comes first."""
    return [row.as_dict() for row, _last_utc in directory.found(context.store, q, archived)]


@router.get("/{code}", **answers(ParticipantOut))
def one_participant(context: Ctx, _who: Tester, code: str, response: Response) -> dict[str, Any]:
    """One participant with its profile."""
    about = seen.participant(code), seen.decisions(code), seen.poses()  # all that a decision on it may rest on
    version = context.store.etag(context.clock, f"/v1/participants/{code}", *about)
    response.headers["ETag"] = version  # read first: it is not newer than what is told
    return find(context, code).as_dict()


@router.put("/{code}/profile", **answers(ChangedOut))
async def set_profile(
    context: Ctx,
    who: Tester,
    code: str,
    body: ProfileIn,
    response: Response,
    void_calibration: Annotated[bool, Query(description="the change may void the calibration of the day")] = False,
) -> dict[str, Any]:
    """Change limits: those that are sent; the others keep their values, and so does what a calibration found.

    A limit wider than at the calibration voids it: 409, unless `void_calibration`. `meanwhile` says what it means for a
    test that runs, or a calibration that is open.
    """
    row, place = await change_profile(context, code, body.sent(), who.name, void_calibration)
    response.headers["ETag"] = place.etag(f"/v1/participants/{code}")
    return {**row.as_dict(), "meanwhile": meanwhile(context, code)}


@router.get("/{code}/tests", **answers(list[TestOut]))
def tests_of(context: Ctx, _who: Tester, code: str) -> list[dict[str, Any]]:
    """A participant's tests, newest first."""
    find(context, code)
    rows = context.store.all(Test, Test.participant == code, order=Test.requested_utc.desc())
    return [context.runner.document(row) for row in rows]
