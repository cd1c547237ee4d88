"""A joint that moves: the angle sensor and its calibration, what is open of the guided tests, one model of them all."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Response
from pydantic import AfterValidator, Field, StrictBool, StringConstraints

from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import FIT_TOGETHER, Job
from stimrig.api.models import together
from stimrig.api.sessions import profiles
from stimrig.api.sessions.kinds import no_sensor
from stimrig.api.sessions.requests import AngleRad, Body
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model, Participant
from stimrig.api.web.dependencies import PROBLEM, AngleVersion, Context, Ctx, LiveReader, Tester
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import VersionOut
from stimrig.api.web.responses.rig import JointOverviewOut
from stimrig.api.web.routes import participants
from stimrig.api.web.routes.criticism import LATER, Wait, later
from stimrig.rig.messages import AngleCalibration, AngleStatus, Status
from stimrig.rig.requests import AnglePoseRequest

router = APIRouter(prefix="/v1", tags=["joint"], responses=PROBLEM)

NOTHING_OPEN: dict[str, Any] = {
    "targets": [], "next_rad": None, "tests": {"passive": None, "moving": None}, "doses": None, "known": False,
    "share_of_paper": None,
}  # fmt: skip


class PoseIn(Body):
    """What a goniometer shows while the joint is held still."""

    angle_rad: AngleRad = Field(description="elbow: 0 is straight, flexion is positive, rad")
    first: StrictBool = Field(False, description="begin anew with this one: a first pose that waits is forgotten")


def _once(recordings: list[str]) -> list[str]:
    if len(set(recordings)) != len(recordings):
        raise ValueError("a recording is named twice")
    return recordings


RecordingId = Annotated[str, StringConstraints(min_length=1, max_length=80)]
EffectId = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,64}(:[a-z0-9_|]{1,100})?$")]


class TogetherIn(Body):
    """Recordings of one participant that are to be fitted as one."""

    recordings: Annotated[list[RecordingId], Field(min_length=1, max_length=together.MOST), AfterValidator(_once)]
    effects: Annotated[list[EffectId], Field(max_length=20)] = Field(
        default=list(together.JOINT_EFFECTS), description="of the model; needs the joint's angle in each recording"
    )


def sensor(context: Context) -> AngleStatus:
    """The rig's angle sensor; 409 where it has none."""
    status = context.rig.status
    if status is None or not status.angle.present:
        raise no_sensor()
    return status.angle


async def overview_of(context: Context, row: Participant) -> dict[str, Any]:
    """What is open of today's guided tests, and the sensor; nothing of tests where there is no sensor or no range."""
    status = context.rig.status
    told = (status.angle if status is not None else AngleStatus()).model_dump()
    if not told["present"] or profiles.range_of(row.profile) is None:
        return {"sensor": told, "range_rad": row.profile.get(profiles.RANGE), **NOTHING_OPEN}
    return {"sensor": told, **await context.runner.joint_overview(row)}


def begin_fit(context: Context, code: str, body: TogetherIn, by: str) -> Job:
    """Fit them while the person looks on."""

    async def work(job: Job) -> str:
        model = await together.fit(context.analyses, code, body.recordings, body.effects, by, job.follow)
        return f"/v1/models/{model.id}"

    return context.jobs.start(FIT_TOGETHER, code, by, work)


@router.get("/rig/angle", **describe_answer(AngleStatus))
async def angle(context: Ctx, _who: LiveReader, response: Response) -> dict[str, Any]:
    """The joint's angle now, and the sensor's calibration: both poses, who and when; `present` is false without one."""
    response.headers["ETag"] = f'"{await asyncio.to_thread(pose_version, context)}"'
    return (await context.rig.fresh_status()).angle.model_dump()


def pose_version(context: Context) -> int:
    """Return the version of the sensor's calibration."""
    with context.store.read() as session:
        return locking.pose_version(session)


@router.post("/rig/angle/pose", **describe_answer(AngleStatus))
async def pose(context: Ctx, who: Tester, tags: AngleVersion, body: PoseIn, response: Response) -> dict[str, Any]:
    """Tell the angle that a goniometer shows, at two poses at least 0.5 rad apart; a third one begins anew."""
    status = await take_pose(context, who.name, body, tags)
    response.headers["ETag"] = f'"{await asyncio.to_thread(pose_version, context)}"'
    return status.angle.model_dump()


async def take_pose(context: Context, by: str, body: PoseIn, tags: Tags | None = None) -> Status:
    """Tell the rig a pose of the sensor. The intent is written before: of one whose answer is lost nobody knows whether
    it was taken.

    Raises ApiError: 409 no sensor, or the rig refuses; 412 another pose was told meanwhile.
    """
    sensor(context)
    told = {"angle_rad": round(body.angle_rad, 4)}

    def write_intent() -> None:
        with context.store.write() as session:
            locking.check_poses(session, tags)
            locking.write_pose(session, context.clock.utc(), by, locking.POSES[0], **told)

    def write_calibration(done: AngleCalibration) -> None:
        with context.store.write() as session:
            locking.write_pose(session, context.clock.utc(), by, locking.POSES[1], **done.model_dump(exclude={"by"}))

    async with context.limits_lock:  # no other pose comes between looking and taking it
        before = context.rig.status.angle.calibration if context.rig.status else None
        await asyncio.to_thread(write_intent)
        try:
            request = AnglePoseRequest(angle_rad=body.angle_rad, by=by, first=body.first)
            status = await context.rig.ask_for(Status, request)
        except ApiError as error:
            await asyncio.to_thread(
                context.store.note, context.clock, by, "pose not taken", "rig", **told, why=error.detail
            )
            raise
        context.rig.status = status
        if (done := status.angle.calibration) is not None and done != before:
            await asyncio.to_thread(write_calibration, done)
    return status


@router.get("/participants/{code}/joint", **describe_answer(JointOverviewOut))
async def overview(context: Ctx, _who: Tester, code: str) -> dict[str, Any]:
    """Today's guided tests: which angles are still to be held, what was done, and the torque-time of all of them."""
    row = await asyncio.to_thread(participants.find, context, code)
    return await overview_of(context, row)


@router.post("/participants/{code}/models", status_code=201, response_model=VersionOut, responses=LATER)
async def fit_together(
    context: Ctx, who: Tester, code: str, body: TogetherIn, response: Response, wait: Wait = True
) -> Any:
    """One model of several recordings, joined: isometric ones and those in which the joint was held or moved."""
    await asyncio.to_thread(participants.find, context, code)
    if not wait:
        return later(begin_fit(context, code, body, who.name))
    model: Model = await together.fit(context.analyses, code, body.recordings, body.effects, who.name)
    response.headers["Location"] = f"/v1/models/{model.id}"
    return await asyncio.to_thread(context.versions.document, model)
