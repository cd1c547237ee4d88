"""The page of a test."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response
from markupsafe import Markup

from stimrig.api.charts import model_charts
from stimrig.api.charts.drawing import svg
from stimrig.api.clinical_words import missing_words
from stimrig.api.errors import ApiError
from stimrig.api.models import stored_model
from stimrig.api.services import notes, tests
from stimrig.api.store.tables import Test
from stimrig.api.web.dependencies import Context, Ctx, LiveReader
from stimrig.api.web.pages.model_view import draw_model, measurement
from stimrig.api.web.pages.render import page
from stimrig.rig.messages import Status

router = APIRouter(include_in_schema=False)


@router.get("/tests/{test_id}")
async def test(request: Request, context: Ctx, _principal: LiveReader, test_id: str) -> Response:
    """A test: live while it runs, its outcome after."""
    row = await asyncio.to_thread(tests.find, context, test_id)
    document = await asyncio.to_thread(context.runner.document, row)
    joint, status = document["joint"], context.rig.status
    grows = document["adaptive"] or (joint and joint["coverage"])
    fixed = [] if grows else (row.plan.get("preview") or {}).get("pulse_width_us") or []
    bounds = limits_of(row, status)
    data = {
        "test": document, "planned_us": fixed, "pulse_rate_hz": row.plan.get("pulse_rate_hz", 40.0), "limits": bounds,
        "sensor": joint is not None or (status is not None and status.angle.present),
    }  # fmt: skip
    picture: dict[str, Any] = (
        await draw_ended(context, row) if document["done"] else {"drawn": None, "drawn_problem": None}
    )
    noted = await asyncio.to_thread(notes.of_test, context.store, test_id)
    missing = missing_words(((joint or {}).get("coverage") or {}).get("missing"))
    return page(request, "test.html", test=document, data=data, limits=bounds, notes=noted, missing=missing, **picture)


def limits_of(row: Test, status: Status | None) -> dict[str, float | None]:
    """Return the limits of the test: its current, the torque that stops it, and the widest pulse."""
    profile = row.plan.get("profile") or {}
    rig = status.limits.get("torque_nm") if status else None
    torque_nm = [profile.get("max_torque_nm"), row.plan.get("max_torque_nm"), rig.hi if rig else None]
    width_us = [profile.get("max_pulse_width_us"), row.plan.get("max_pulse_width_us")]
    return {
        "current_ma": profile.get("current_ma"),
        "torque_nm": min((value for value in torque_nm if value is not None), default=None),
        "pulse_width_us": min((value for value in width_us if value is not None), default=None),
    }


async def draw_ended(context: Context, row: Test) -> dict[str, Any]:
    """A test that is over as a still picture: beside its model where there is one, else what was recorded."""
    picture, problem = None, None
    try:
        picture = await measured(context, row.model_id) if row.model_id else None
        if picture is None and row.recording_id:
            picture = await what_was_recorded(context, row)
    except ApiError as error:
        problem = error
    return {"drawn": picture, "drawn_problem": problem}


async def measured(context: Context, model_id: str) -> Markup | None:
    """Draw the measured torque with the model's free run; None without curves."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    measurements = await measurement(context, row)
    if measurements["curves"] is None:
        return None
    figure = draw_model(stored_model.read(row), measurements)["comparison"]
    words = "Torque measured and predicted, what is left, and the pulse width, over time"
    return await asyncio.to_thread(svg, figure, 1160.0, 520.0, words)


async def what_was_recorded(context: Context, row: Test) -> Markup:
    """Torque and the pulses that were sent, up to the test's end; the rest of the plan faint."""
    path = await asyncio.to_thread(context.analyses.path, str(row.recording_id))
    recorded = await context.pool.submit("recorded", urgent=True, data=path).result
    plan_us = [] if row.plan.get("adaptive") else (row.plan.get("preview") or {}).get("pulse_width_us") or []
    figure = model_charts.recorded(recorded, plan_us, row.plan.get("pulse_rate_hz", 40.0), row.state)
    words = "Torque that was measured and pulses that were sent, over time"
    return await asyncio.to_thread(svg, figure, 1160.0, 460.0, words)
