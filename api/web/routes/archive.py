"""The archive: participants who do not come any more are out of the way, and nothing of theirs is deleted."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter

from api.errors import ApiError, NotFoundError
from api.store import audit, seen
from api.store.holds import LIMITS_TURN
from api.store.tables import Participant
from api.web.dependencies import PROBLEM, Context, Ctx, Tester
from api.web.responses.base import answers
from api.web.responses.participants import ParticipantOut

router = APIRouter(prefix="/v1/participants/{code}", tags=["participants"], responses=PROBLEM)


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
        row = session.get(Participant, code)
        if row is None:
            raise NotFoundError("participant", code)
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
