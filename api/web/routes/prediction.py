"""A trial foretold: what a model says a list of pulse widths would give."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import Field, FiniteFloat

from api.models import stored
from api.sessions.requests import Body
from api.web.dependencies import PROBLEM, Ctx, ModelReader
from api.web.responses.base import answers
from api.web.responses.models import PredictionOut

router = APIRouter(prefix="/v1", tags=["models"], responses=PROBLEM)

WidthUs = Annotated[FiniteFloat, Field(ge=0, le=500)]


class WidthsIn(Body):
    """One pulse width for each pulse."""

    pulse_width_us: Annotated[list[WidthUs], Field(min_length=1, max_length=12_000, description="µs")]
    pulse_rate_hz: Annotated[FiniteFloat, Field(ge=10, le=100)] = 40.0


@router.post("/models/{model_id}/prediction", **answers(PredictionOut))
async def prediction(context: Ctx, _who: ModelReader, model_id: str, body: WidthsIn) -> dict[str, Any]:
    """Mean torque the pulses give in each pulse's period, N·m, after a second of rest; effects included."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    call = context.pool.submit(
        "forecast", urgent=True, model_json=stored.text(row), pulse_width_us=body.pulse_width_us,
        pulse_rate_hz=body.pulse_rate_hz,
    )  # fmt: skip
    found = await call.result
    return {"model_id": row.id, "pulse_rate_hz": body.pulse_rate_hz, **found}
