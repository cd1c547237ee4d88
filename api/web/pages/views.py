"""What is looked at: a test."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response
from markupsafe import Markup

from api.charts import model_charts
from api.charts.svg import svg
from api.errors import ApiError
from api.store.tables import Test
from api.web.dependencies import Context, Ctx, LiveReader
from api.web.pages.model_view import measurement
from api.web.pages.render import page
from api.web.routes import tests

router = APIRouter(include_in_schema=False)


@router.get("/tests/{test_id}")
async def test(request: Request, context: Ctx, _who: LiveReader, test_id: str) -> Response:
    """A test: live while it runs, its outcome after."""
    row = await asyncio.to_thread(tests.find, context, test_id)
    document = await asyncio.to_thread(context.runner.document, row)
    planned = (row.plan.get("preview") or {}).get("pulse_width_us") or []
    data = {"test": document, "planned_us": planned, "pulse_rate_hz": row.plan.get("pulse_rate_hz", 40.0)}
    shown: dict[str, Any] = await drawn(context, row) if document["done"] else {"drawn": None, "drawn_problem": None}
    return page(request, "test.html", test=document, data=data, **shown)


async def drawn(context: Context, row: Test) -> dict[str, Any]:
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
    """What was measured, with the model's free run; None where it cannot be had."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    found = await measurement(context, row)
    if found["curves"] is None:
        return None
    figure = model_charts.of_model(json.loads(row.document), found["curves"], found["comparison"])["comparison"]
    return svg(figure, 1160.0, 520.0, "Torque measured and predicted, what is left, and the pulse width, over time")


async def what_was_recorded(context: Context, row: Test) -> Markup:
    """Torque and the pulses that were sent, up to the test's end; the rest of the plan faint."""
    path = await asyncio.to_thread(context.analyses.path, str(row.recording_id))
    found = await context.pool.submit("recorded", urgent=True, data=path).result
    plan_us = (row.plan.get("preview") or {}).get("pulse_width_us") or []
    figure = model_charts.recorded(found, plan_us, row.plan.get("pulse_rate_hz", 40.0), row.state)
    return svg(figure, 1160.0, 460.0, "Torque that was measured and pulses that were sent, over time")
