"""The site of a participant that is stimulated, and the archive.

Models, approvals and keys belong to one site. In the archive participants who do not come any more are out of the way,
and nothing of theirs is deleted.
"""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query

from stimrig.api.errors import ApiError
from stimrig.api.models.places import Site, in_words, site_of
from stimrig.api.sessions import profiles
from stimrig.api.sessions.requests import MuscleIn
from stimrig.api.store import audit, seen
from stimrig.api.store.holds import LIMITS_TURN
from stimrig.api.store.tables import Participant
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, Tester
from stimrig.api.web.responses.base import answers
from stimrig.api.web.responses.participants import ParticipantOut
from stimrig.api.web.routes import participants

router = APIRouter(prefix="/v1/participants/{code}", tags=["participants"], responses=PROBLEM)


async def change(context: Context, code: str, body: MuscleIn, by: str, voids: bool = False) -> Participant:
    """Say another site. What a calibration found at the one before does not hold for it, nor do models and keys.

    Raises
    ------
    ApiError
        404 no such participant; 409 a test or calibration of it is under way, or the calibration would be lost and
        that was not allowed.
    """
    async with context.holds.turn(LIMITS_TURN):
        refuse_busy(context, code)
        return await asyncio.to_thread(_change, context, code, body, by, voids)


def loses(row: Participant, body: MuscleIn) -> bool:
    """Whether a calibration is lost: it was found at another site than the new one."""
    found = any(row.profile.get(name) is not None for name in profiles.FOUND)
    pairs = zip(site_of(row), site_in(body), strict=True)
    return found and any(before is not None and before != after for before, after in pairs)


def site_in(body: MuscleIn) -> Site:
    """The site that is asked for."""
    return body.side, body.muscle, body.placement


def _change(context: Context, code: str, body: MuscleIn, by: str, voids: bool) -> Participant:
    now = context.clock.utc()
    with context.store.write() as session:
        row = participants.within(session, code)
        seen.check(session, seen.participant(code))
        lost = loses(row, body)
        if lost and not voids:
            detail = (
                f"The thresholds of {code} were found at {in_words(site_of(row))}. To change it and make the "
                "calibration invalid: ?void_calibration=true."
            )
            raise ApiError(409, "voids-calibration", "This would make the calibration invalid", detail)
        if site_of(row) != site_in(body):
            row.side, row.muscle, row.placement = site_in(body)
            row.profile = {**row.profile, **dict.fromkeys(profiles.FOUND)} if lost else row.profile
            audit.write(session, now, by, "set muscle", code, **body.model_dump(), voids_calibration=lost)
    return row


@router.put("/muscle", **answers(ParticipantOut))
async def set_muscle(
    context: Ctx,
    who: Tester,
    code: str,
    body: MuscleIn,
    void_calibration: Annotated[bool, Query(description="the change may void the calibration of the day")] = False,
) -> dict[str, Any]:
    """Say the site. Another one than before voids the calibration: 409, unless allowed.

    A model belongs to the site at which it was measured: at another one there is no approved model, and no key of a
    controller, until it has its own. Tests keep the site that they were begun with.
    """
    return (await change(context, code, body, who.name, void_calibration)).as_dict()


async def put(context: Context, code: str, archived: bool, by: str) -> Participant:
    """Put a participant into the archive, or take it out; doing it again changes nothing.

    Raises
    ------
    ApiError
        404 no such participant; 409 a test or a calibration of it is under way.
    """
    async with context.holds.turn(LIMITS_TURN):  # nothing begins meanwhile
        if archived:
            refuse_busy(context, code)
        return await asyncio.to_thread(_put, context, code, archived, by)


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


def _put(context: Context, code: str, archived: bool, by: str) -> Participant:
    now = context.clock.utc()
    with context.store.write() as session:
        row = participants.within(session, code)
        seen.check(session, seen.participant(code))
        if archived != (row.archived_utc is not None):
            row.archived_utc = now if archived else None
            audit.write(session, now, by, "archive" if archived else "unarchive", code)
    return row


@router.post("/archive", **answers(ParticipantOut))
async def archive(context: Ctx, who: Tester, code: str) -> dict[str, Any]:
    """Put it into the archive: it is listed no more by default, and no test of it starts."""
    return (await put(context, code, True, who.name)).as_dict()


@router.post("/unarchive", **answers(ParticipantOut))
async def unarchive(context: Ctx, who: Tester, code: str) -> dict[str, Any]:
    """Take it out of the archive."""
    return (await put(context, code, False, who.name)).as_dict()
