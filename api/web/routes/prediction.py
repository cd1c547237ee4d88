"""A trial foretold: what a list of pulse widths would give, and which widths give a torque that is wanted."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import Field, FiniteFloat, StrictBool, model_validator

from stimrig.api.sessions.limits import tighter
from stimrig.api.sessions.requests import Body
from stimrig.api.store.tables import Participant
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, ModelReader
from stimrig.api.web.responses.base import answers
from stimrig.api.web.responses.models import InversionOut, PredictionOut

router = APIRouter(prefix="/v1", tags=["models"], responses=PROBLEM)

REST_S = 1.0
"""Before and after a trial: its torque is measured against the rest before it."""
RISE = "width_rise_us"
Column = Annotated[list[FiniteFloat], Field(min_length=1, max_length=60_000)]
WidthUs = Annotated[FiniteFloat, Field(ge=0, le=500)]
Angles = Annotated[
    list[Annotated[FiniteFloat, Field(ge=-7, le=7)]],
    Field(
        min_length=1, max_length=60_000, description="of the joint where it moves, rad; as many as torques or widths"
    ),
]


class WidthsIn(Body):
    """One pulse width for each pulse."""

    pulse_width_us: Annotated[list[WidthUs], Field(min_length=1, max_length=12_000, description="µs")]
    pulse_rate_hz: Annotated[FiniteFloat, Field(ge=10, le=100)] = 40.0
    angle_rad: Angles | None = None

    @model_validator(mode="after")
    def _as_many(self) -> WidthsIn:
        if self.angle_rad is not None and len(self.angle_rad) != len(self.pulse_width_us):
            raise ValueError(f"{len(self.angle_rad)} angles for {len(self.pulse_width_us)} widths: give one for each")
        return self


@router.post("/models/{model_id}/prediction", **answers(PredictionOut))
async def prediction(context: Ctx, _who: ModelReader, model_id: str, body: WidthsIn) -> dict[str, Any]:
    """Mean torque the pulses give in each pulse's period, N·m, after a second of rest; effects included.

    Of a version, or of one that was tracked from it (its `model_id`).
    """
    text = await asyncio.to_thread(context.tracked.text_of, model_id)
    call = context.pool.submit(
        "forecast", urgent=True, model_json=text, pulse_width_us=body.pulse_width_us,
        pulse_rate_hz=body.pulse_rate_hz, angle_rad=body.angle_rad,
    )  # fmt: skip
    found = await call.result
    return {"model_id": model_id, "pulse_rate_hz": body.pulse_rate_hz, **found}


class ReferenceIn(Body):
    """A torque to follow."""

    reference_torque_nm: Annotated[Column, Field(description="above rest, N·m; one for each pulse, without `time_s`")]
    time_s: Annotated[Column, Field(description="times of the torques, s, rising; of any rate")] | None = None
    angle_rad: Angles | None = None
    pulse_rate_hz: FiniteFloat | None = Field(None, ge=10, le=100, description="None: the model's")
    max_pulse_width_us: FiniteFloat | None = Field(None, gt=0, le=500, description="never above the participant's, µs")
    max_rise_us: FiniteFloat | None = Field(None, gt=0, le=500, description="from pulse to pulse, µs; None: the rig's")
    whole_us: StrictBool = Field(True, description="whole µs")


@router.post("/models/{model_id}/widths", **answers(InversionOut))
async def widths(context: Ctx, _who: ModelReader, model_id: str, body: ReferenceIn) -> dict[str, Any]:
    """The pulse widths whose predicted torque follows a reference best, and where and why it is out of reach.

    Of a version, or of one that was tracked from it (its `model_id`).
    """
    given = body.model_dump(include={"reference_torque_nm", "time_s", "angle_rad", "pulse_rate_hz"})
    return await inverted(context, model_id, given, body.max_pulse_width_us, body.max_rise_us, body.whole_us)


async def inverted(
    context: Context, model_id: str, given: dict[str, Any], width_us: float | None = None, rise_us: float | None = None,
    whole: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """What a worker makes of a reference, within the limits of participant and rig.

    Parameters
    ----------
    given : dict
        The reference, as the verb `invert` takes it.
    width_us, rise_us : float, optional
        Further limits.
    """
    text = await asyncio.to_thread(context.tracked.text_of, model_id)
    version = await asyncio.to_thread(context.tracked.version_of, model_id)
    participant: Participant = await asyncio.to_thread(context.store.get, Participant, version.participant)
    largest_us = tighter(width_us, participant.profile.get("max_pulse_width_us"))
    rise_us = tighter(rise_us, _rise_of_rig(context))
    call = context.pool.submit(
        "invert", urgent=True, model_json=text, largest_us=largest_us, rise_us=rise_us, whole=whole, **given
    )
    found = await call.result
    limits = {"max_pulse_width_us": largest_us, "max_rise_us": rise_us}
    return {"model_id": model_id, **found, **limits, "segments": segments(found["pulse_width_us"])}


def _rise_of_rig(context: Context) -> float | None:
    bound = context.rig.status.limits.get(RISE) if context.rig.status else None
    return bound.hi if bound else None


def segments(pulse_width_us: list[float]) -> list[dict[str, Any]]:
    """A trial of these widths between two rests, for `POST /v1/tests`."""
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": REST_S}}
    return [rest, {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": pulse_width_us}}, rest]
