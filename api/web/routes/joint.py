"""A joint that moves: the angle sensor and its calibration, what is open of the guided tests, one model of them all."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Response

from stimrig.api.jobs.job import FIT_TOGETHER, Job
from stimrig.api.models import together
from stimrig.api.services import joint, participants
from stimrig.api.services.joint import PoseIn, TogetherIn
from stimrig.api.store import locking
from stimrig.api.web.dependencies import PROBLEM, AngleVersion, Ctx, LiveReader, Tester
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import VersionOut
from stimrig.api.web.responses.rig import JointOverviewOut
from stimrig.api.web.routes.criticism import LATER, Wait, later
from stimrig.rig.messages import AngleStatus

router = APIRouter(prefix="/v1", tags=["joint"], responses=PROBLEM)


@router.get("/rig/angle", **describe_answer(AngleStatus))
async def angle(context: Ctx, _principal: LiveReader, response: Response) -> dict[str, Any]:
    """The joint's angle now, and the sensor's calibration: both poses, who and when; `present` is false without one."""

    def version() -> int:
        with context.store.read() as session:
            return locking.pose_version(session)

    response.headers["ETag"] = f'"{await asyncio.to_thread(version)}"'
    return (await context.rig.fresh_status()).angle.model_dump()


@router.post("/rig/angle/pose", **describe_answer(AngleStatus))
async def pose(context: Ctx, principal: Tester, tags: AngleVersion, body: PoseIn, response: Response) -> dict[str, Any]:
    """Tell the angle that a goniometer shows, at two poses at least 0.5 rad apart; a third one begins anew."""
    status, version = await joint.take_pose(context, principal.name, body, tags)
    response.headers["ETag"] = f'"{version}"'
    return status.angle.model_dump()


@router.get("/participants/{code}/joint", **describe_answer(JointOverviewOut))
async def overview(context: Ctx, _principal: Tester, code: str) -> dict[str, Any]:
    """Today's guided tests: which angles are still to be held, what was done, and the torque-time of all of them."""
    row = await asyncio.to_thread(participants.find, context, code)
    return await joint.overview_of(context, row)


@router.post("/participants/{code}/models", status_code=201, response_model=VersionOut, responses=LATER)
async def fit_together(
    context: Ctx, principal: Tester, code: str, body: TogetherIn, response: Response, wait: Wait = True
) -> Any:
    """One model of several recordings, joined: isometric ones and those in which the joint was held or moved."""
    await asyncio.to_thread(participants.find, context, code)
    arguments = context.analyses, code, body.recordings, body.effects, principal.name
    if not wait:

        async def work(job: Job) -> str:
            return f"/v1/models/{(await together.fit(*arguments, job.follow)).id}"

        return later(context.jobs.start(FIT_TOGETHER, code, work, (body.model_dump(), principal.name)))
    model = await together.fit(*arguments)
    response.headers["Location"] = f"/v1/models/{model.id}"
    return await asyncio.to_thread(context.versions.document, model)
