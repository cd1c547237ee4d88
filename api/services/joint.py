"""A joint that moves: the angle sensor and its calibration, and what is open of the guided tests."""

from __future__ import annotations

import asyncio
import math
from typing import Annotated, Any

from pydantic import AfterValidator, Field, FiniteFloat, StrictBool, StringConstraints

from stimrig.api.errors import ApiError, invalid
from stimrig.api.models import together
from stimrig.api.services.context import Context
from stimrig.api.sessions import profiles
from stimrig.api.sessions.kinds import no_sensor
from stimrig.api.sessions.requests import Body
from stimrig.api.store import locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Participant
from stimrig.rig.messages import AngleStatus, Status
from stimrig.rig.requests import AnglePoseRequest

NOTHING_OPEN: dict[str, Any] = {
    "targets": [], "next_rad": None, "tests": {"passive": None, "moving": None}, "doses": None, "known": False,
    "share_of_paper": None,
}  # fmt: skip


class PoseIn(Body):
    """Reading of a goniometer while the joint is held still."""

    angle_rad: FiniteFloat = Field(description="elbow: 0 is straight, flexion is positive, rad")
    first: StrictBool = Field(False, description="begin anew with this one: a first pose that waits is forgotten")


def _once(recordings: list[str]) -> list[str]:
    if len(set(recordings)) != len(recordings):
        raise ValueError("a recording is named twice")
    return recordings


RecordingId = Annotated[str, StringConstraints(min_length=1, max_length=80)]
EffectId = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,64}(:[a-z0-9_|]{1,100})?$")]


class TogetherIn(Body):
    """Recordings of one participant that are to be fitted as one."""

    recordings: Annotated[
        list[RecordingId], Field(min_length=1, max_length=together.MAX_RECORDINGS), AfterValidator(_once)
    ]
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
    """Return the sensor and today's open guided tests; no tests without a sensor or a range of angles."""
    angle = context.rig.status.angle if context.rig.status else AngleStatus()
    range_rad = row.profile.get(profiles.RANGE)
    opened = await context.runner.joint_overview(row) if angle.present and range_rad else NOTHING_OPEN
    return {"sensor": angle.model_dump(), "range_rad": range_rad, **opened}


async def take_pose(context: Context, by: str, body: PoseIn, tags: Tags) -> tuple[Status, int]:
    """Tell the rig a pose of the sensor: the rig's state, and the version that the sensor's calibration has now.

    The intent is written before: of one whose answer is lost nobody knows whether it was taken.

    Raises ApiError: 409 no sensor, or the rig refuses; 412 another pose was told meanwhile;
    422 it is no angle of this rig.
    """
    low_rad, high_rad = sensor(context).range_rad or (profiles.LEAST_RAD, profiles.MOST_RAD)
    if not (low_rad <= body.angle_rad <= high_rad):
        within = profiles.range_words((low_rad, high_rad))
        words = f"{math.degrees(body.angle_rad):.0f}° is not within {within}, as this rig asks"
        raise invalid(f"angle_rad: {words}", errors=[{"field": "angle_rad", "detail": words}])
    pose = {"angle_rad": round(body.angle_rad, 4)}

    def write(action: str, detail: dict[str, Any]) -> int:
        with context.store.write() as session:
            if action == locking.POSES[0]:
                locking.check(session, None, tags)
            return locking.write_pose(session, context.clock.utc(), by, action, **detail)

    async with context.limits_lock:  # no other pose comes between looking and taking it
        before = context.rig.status.angle.calibration if context.rig.status else None
        version = await asyncio.to_thread(write, locking.POSES[0], pose)
        try:
            request = AnglePoseRequest(angle_rad=body.angle_rad, by=by, first=body.first)
            status = await context.rig.ask_for(Status, request)
        except ApiError as error:
            note = {**pose, "why": error.detail}
            await asyncio.to_thread(context.store.note, context.clock, by, "pose not taken", "rig", **note)
            raise
        context.rig.status = status
        if (done := status.angle.calibration) is not None and done != before:
            version = await asyncio.to_thread(write, locking.POSES[1], done.model_dump(exclude={"by"}))
    return status, version
