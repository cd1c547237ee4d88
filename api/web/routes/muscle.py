"""Which side and which muscle of a participant is stimulated."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query

from api.errors import ApiError, NotFoundError
from api.sessions import profiles
from api.sessions.requests import MuscleIn
from api.store import audit
from api.store.holds import LIMITS_TURN
from api.store.tables import Participant
from api.web.dependencies import PROBLEM, Context, Ctx, Tester
from api.web.responses.base import answers
from api.web.responses.participants import ParticipantOut
from api.web.routes.archive import refuse_busy

router = APIRouter(prefix="/v1/participants/{code}", tags=["participants"], responses=PROBLEM)


async def change(context: Context, code: str, body: MuscleIn, by: str, voids: bool = False) -> Participant:
    """Say another side or muscle. What a calibration found at the one before does not hold for it.

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
    """Whether a calibration is lost: it was found at another side or muscle than the new one."""
    found = any(row.profile.get(name) is not None for name in profiles.FOUND)
    pairs = ((row.side, body.side), (row.muscle, body.muscle))
    return found and any(before is not None and before != after for before, after in pairs)


def _change(context: Context, code: str, body: MuscleIn, by: str, voids: bool) -> Participant:
    now = context.clock.utc()
    with context.store.write() as session:
        row = session.get(Participant, code)
        if row is None:
            raise NotFoundError("participant", code)
        lost = loses(row, body)
        if lost and not voids:
            detail = (
                f"The thresholds of {code} were found at {words(row.side, row.muscle)}. To change it and make the "
                "calibration invalid: ?void_calibration=true."
            )
            raise ApiError(409, "voids-calibration", "This would make the calibration invalid", detail)
        if (row.side, row.muscle) != (body.side, body.muscle):
            row.side, row.muscle = body.side, body.muscle
            row.profile = {**row.profile, **dict.fromkeys(profiles.FOUND)} if lost else row.profile
            audit.write(session, now, by, "set muscle", code, side=row.side, muscle=row.muscle, voids_calibration=lost)
    return row


def words(side: str | None, muscle: str | None) -> str:
    """As a person says it: left biceps brachii."""
    return " ".join(part for part in (side, muscle) if part) or "a side and muscle that nobody has said"


@router.put("/muscle", **answers(ParticipantOut))
async def set_muscle(
    context: Ctx,
    who: Tester,
    code: str,
    body: MuscleIn,
    void_calibration: Annotated[bool, Query(description="the change may void the calibration of the day")] = False,
) -> dict[str, Any]:
    """Say which side and muscle is stimulated. Another one than before voids the calibration: 409, unless allowed.

    Tests that were made keep the side and muscle that they were begun with.
    """
    return (await change(context, code, body, who.name, void_calibration)).as_dict()
