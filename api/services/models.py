"""A model diagnosed; its predictions for a trial: the torque of pulse widths, and the widths for a reference torque."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from pydantic import Field, FiniteFloat, StrictBool, model_validator

from stimrig.api.jobs.job import Job
from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import Body
from stimrig.api.store.tables import Model, Participant

RISE = "width_rise_us"
REST_S = 1.0
"""Before and after a trial: its torque is measured against the rest before it."""
Column = Annotated[list[FiniteFloat], Field(min_length=1, max_length=60_000)]
WidthUs = Annotated[FiniteFloat, Field(ge=0, le=500)]
ModelsRateHz = Annotated[
    Annotated[FiniteFloat, Field(ge=1.0, le=100.0)] | None,
    Field(description="null: the model's; more than a quarter off that is refused, Hz"),
]
Angles = Annotated[
    list[Annotated[FiniteFloat, Field(ge=-7, le=7)]],
    Field(
        min_length=1, max_length=60_000, description="of the joint where it moves, rad; as many as torques or widths"
    ),
]


class WidthsIn(Body):
    """One pulse width for each pulse."""

    pulse_width_us: Annotated[list[WidthUs], Field(min_length=1, max_length=12_000, description="µs")]
    pulse_rate_hz: ModelsRateHz = None
    angle_rad: Angles | None = None

    @model_validator(mode="after")
    def _as_many(self) -> WidthsIn:
        if self.angle_rad is not None and len(self.angle_rad) != len(self.pulse_width_us):
            raise ValueError(f"{len(self.angle_rad)} angles for {len(self.pulse_width_us)} widths: give one for each")
        return self


class ReferenceIn(Body):
    """A torque to follow, as numbers or as the text of a table."""

    reference_torque_nm: (
        Annotated[Column, Field(description="above rest, N·m; one for each pulse, without `time_s`")] | None
    ) = None
    table: Annotated[str, Field(description="instead: a CSV file with `time_s,torque_nm`, or `torque_nm`")] | None = (
        None
    )
    time_s: Annotated[Column, Field(description="times of the torques, s, rising by at most 1 s")] | None = None
    angle_rad: Angles | None = None
    pulse_rate_hz: ModelsRateHz = None
    max_pulse_width_us: FiniteFloat | None = Field(None, gt=0, le=500, description="never above the participant's, µs")
    max_rise_us: FiniteFloat | None = Field(None, gt=0, le=500, description="from pulse to pulse, µs; None: the rig's")
    whole_us: StrictBool = Field(True, description="whole µs")

    @model_validator(mode="after")
    def _one_reference(self) -> ReferenceIn:
        if (self.reference_torque_nm is None) == (self.table is None):
            raise ValueError("give reference_torque_nm, or the text of a table")
        return self


def begin_diagnosis(context: Context, model: Model) -> Job:
    """Diagnose as a job that a person looks on at."""

    async def work(job: Job) -> str:
        await context.analyses.diagnosis(model, job.follow)
        return f"/v1/models/{model.id}/diagnosis"

    return context.jobs.start("diagnosis", model.id, work)


async def predict(context: Context, model_id: str, body: WidthsIn) -> dict[str, Any]:
    """Predict the mean torque in each pulse's period, of a version or of one that was tracked from it."""
    _version, text = await asyncio.to_thread(context.tracked.find, model_id)
    forecast = await context.pool.submit("forecast", urgent=True, model_json=text, **body.model_dump()).result
    return {"model_id": model_id, **forecast}


async def invert(context: Context, model_id: str, body: ReferenceIn) -> dict[str, Any]:
    """Invert a version, or one that was tracked from it, within the limits of participant and rig.

    `segments` is the trial of these widths between two rests, for `POST /v1/tests`.
    """
    version, text = await asyncio.to_thread(context.tracked.find, model_id)
    participant: Participant = await asyncio.to_thread(context.store.get, Participant, version.participant)
    rig = context.rig.status
    rise, shortest_us = (rig.limits.get(RISE), rig.stimulator.get("shortest_us")) if rig else (None, None)
    largest_us = tighter(body.max_pulse_width_us, participant.profile.get("max_pulse_width_us"))
    rise_us = tighter(body.max_rise_us, None if rise is None else rise.hi)
    reference = body.model_dump(include={"reference_torque_nm", "time_s", "angle_rad", "pulse_rate_hz", "table"})
    inverted = await context.pool.submit(
        "invert", urgent=True, model_json=text, largest_us=largest_us, rise_us=rise_us, whole=body.whole_us,
        shortest_us=shortest_us or 0.0, **reference,
    ).result  # fmt: skip
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": REST_S}}
    trial = {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": inverted["pulse_width_us"]}}
    limits = {"max_pulse_width_us": largest_us, "max_rise_us": rise_us, "shortest_pulse_us": shortest_us}
    return {"model_id": model_id, **inverted, **limits, "segments": [rest, trial, rest]}


def tighter(first: float | None, second: float | None) -> float | None:
    """Return the smaller of the two limits; None where neither is set."""
    return min((value for value in (first, second) if value is not None), default=None)
