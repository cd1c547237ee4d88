"""A trial foretold: what a model says a list of pulse widths would give."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import Field, FiniteFloat, model_validator

from api.sessions.requests import Body
from api.web.dependencies import PROBLEM, Ctx, ModelReader
from api.web.responses.base import answers
from api.web.responses.models import PredictionOut

router = APIRouter(prefix="/v1", tags=["models"], responses=PROBLEM)

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
