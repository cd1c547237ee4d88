"""Participants: codes and a profile of limits, no names."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from api import audit
from api.context import PROBLEM, Context, Ctx, Tester
from api.errors import ApiError, NotFoundError
from api.schemas import ParticipantIn, ProfileIn
from api.store.tables import Participant, Test

router = APIRouter(prefix="/v1/participants", tags=["participants"], responses=PROBLEM)


def create(context: Context, body: ParticipantIn, by: str) -> Participant:
    """A new participant; 409 where the code is taken."""
    now = context.clock.utc()
    with context.store.write() as session:
        if session.get(Participant, body.code) is not None:
            raise ApiError(409, "exists", "The code is taken", f"Participant {body.code!r} exists. Take another code.")
        row = Participant(code=body.code, profile=body.profile.model_dump(), created_utc=now, created_by=by)
        session.add(row)
        session.flush()
        audit.write(session, now, by, "create participant", body.code, profile=row.profile)
    return row


def find(context: Context, code: str) -> Participant:
    """A participant by its code; 404 where there is none."""
    row = context.store.get(Participant, code)
    if row is None:
        raise NotFoundError("participant", code, "POST /v1/participants makes one.")
    return row


def change_profile(context: Context, code: str, body: ProfileIn, by: str) -> Participant:
    """New limits for a participant; 404 where there is none."""
    with context.store.write() as session:
        row = session.get(Participant, code)
        if row is None:
            raise NotFoundError("participant", code)
        row.profile = body.model_dump()
        audit.write(session, context.clock.utc(), by, "set profile", code, profile=row.profile)
    return row


@router.post("", status_code=201)
def make_participant(context: Ctx, who: Tester, body: ParticipantIn, response: Response) -> dict[str, Any]:
    """Make a participant: a code, never a name."""
    row = create(context, body, who.name)
    response.headers["Location"] = f"/v1/participants/{row.code}"
    return row.as_dict()


@router.get("")
def list_participants(context: Ctx, _who: Tester) -> list[dict[str, Any]]:
    """All participants, by code."""
    return [row.as_dict() for row in context.store.all(Participant, order=Participant.code)]


@router.get("/{code}")
def one_participant(context: Ctx, _who: Tester, code: str) -> dict[str, Any]:
    """One participant with its profile."""
    return find(context, code).as_dict()


@router.put("/{code}/profile")
def set_profile(context: Ctx, who: Tester, code: str, body: ProfileIn) -> dict[str, Any]:
    """Set the limits for the day."""
    return change_profile(context, code, body, who.name).as_dict()


@router.get("/{code}/tests")
def tests_of(context: Ctx, _who: Tester, code: str) -> list[dict[str, Any]]:
    """A participant's tests, newest first."""
    find(context, code)
    rows = context.store.all(Test, Test.participant == code, order=Test.requested_utc.desc())
    return [context.trials.public(row) for row in rows]
