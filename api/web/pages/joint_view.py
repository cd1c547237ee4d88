"""The guided tests of a joint that moves: what was done, what is next, one model of all; and the angle sensor."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from stimrig.api.errors import ApiError
from stimrig.api.services import joint, participants
from stimrig.api.sessions import profiles
from stimrig.api.sessions.joint import target_of
from stimrig.api.sessions.joint_plan import KINDS
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store.tables import Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import starting
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/participants/{code}/joint")
async def show(request: Request, context: Ctx, _principal: Tester, code: str) -> Response:
    """Show sensor, range, the three kinds of tests with what is open, and the recordings of today."""
    row = await asyncio.to_thread(participants.find, context, code)
    problem = None
    try:
        overview = await joint.overview_of(context, row)
    except ApiError as error:
        problem = error
        overview = {"sensor": joint.sensor(context).model_dump(), "range_rad": None, **joint.NOTHING_OPEN}
    gathered = await asyncio.to_thread(_gather, context, row, overview)
    return page(request, "joint.html", participant=row, overview=overview, problem=problem, **gathered)


def _gather(context: Context, row: Participant, overview: dict[str, Any]) -> dict[str, Any]:
    conditions = (
        Test.participant == row.code, Test.state == "completed", Test.recording_id.is_not(None), Test.kind != SEQUENCE,
        Test.requested_utc >= context.clock.start_of_day_utc(),
    )  # fmt: skip
    rows = context.store.all(Test, *conditions, order=Test.requested_utc)
    kinds = [test.kind if test.kind in KINDS else "isometric" for test in rows]
    newest = {(kind, f"{target_of(test):.1f}"): test.id for kind, test in zip(kinds, rows, strict=True)}
    picked = set(newest.values())
    return {
        "range_rad": profiles.range_of(row.profile),
        "may_start": starting.calibrated(context, row).may_start,
        "held": [{**each, "deg": starting.allowed_deg(each["angle_rad"])} for each in overview["targets"]],
        "allowed": starting.allowed_deg(overview["next_rad"]),
        "recordings": [{"test": test, "picked": test.id in picked, "target_rad": target_of(test)} for test in rows],
        "kinds_lacking": [kind for kind in KINDS if kind not in kinds],
    }


@router.get("/rig/angle")
async def show_sensor(
    request: Request, context: Ctx, _principal: Tester, restart: Annotated[str, Query(alias="again")] = ""
) -> Response:
    """Show what the sensor reads, how it was calibrated, and the next pose; `restart`: from the first pose."""
    if context.rig.connected:
        await context.rig.fresh_status()
    sensor = joint.sensor(context)
    return page(request, "angle.html", sensor=sensor, second=sensor.pose is not None and not restart)
