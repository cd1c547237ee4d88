"""The page of a test: live while it runs, its outcome after."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request
from fastapi.responses import Response
from markupsafe import Markup

from stimrig.api.charts import model_charts
from stimrig.api.clinical_words import WORDS, missing_words
from stimrig.api.errors import ApiError
from stimrig.api.services import notes, tests
from stimrig.api.store.tables import Test
from stimrig.api.web.dependencies import Context, Ctx, LiveReader
from stimrig.api.web.pages.model_view import measurement
from stimrig.api.web.pages.render import page
from stimrig.rig.messages import Status

router = APIRouter(include_in_schema=False)


@router.get("/tests/{test_id}")
async def test(request: Request, context: Ctx, _principal: LiveReader, test_id: str) -> Response:
    """Show a test."""
    row = await asyncio.to_thread(tests.find, context, test_id)
    document = await asyncio.to_thread(context.runner.document, row)
    joint, status = document["joint"], context.rig.status
    plan_us = (row.plan.get("preview") or {}).get("pulse_width_us") or []
    fixed_us = [] if document["adaptive"] or (joint and joint["coverage"]) else plan_us
    data = {
        "test": document, "planned_us": fixed_us, "pulse_rate_hz": row.plan.get("pulse_rate_hz", 40.0),
        "limits": limits_of(row, status), "words": {kind: WORDS[kind] for kind in ("segment", "state")},
        "sensor": joint is not None or (status is not None and status.angle.present),
    }  # fmt: skip
    drawn, problem = None, None
    try:
        drawn = await draw(context, row, fixed_us) if document["done"] else None
    except ApiError as error:
        problem = error
    noted = await asyncio.to_thread(notes.of_test, context.store, test_id)
    missing = missing_words(((joint or {}).get("coverage") or {}).get("missing"))
    return page(
        request, "test.html", test=document, data=data, notes=noted, missing=missing, drawn=drawn, problem=problem
    )


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


async def draw(context: Context, row: Test, plan_us: list[float]) -> Markup | None:
    """Draw a test that is over: beside its model, or what was recorded with the rest of the plan faint."""
    if row.model_id:
        model = await asyncio.to_thread(context.versions.get, row.model_id)
        measured = await measurement(context, model)
        if measured["curves"] is not None:
            series = measured["comparison"].get("series")
            figure = model_charts.measurement(measured["curves"], model.fit.get("noise_sd_nm"), series)
            words = "Torque measured and predicted, what is left, and the pulse width, over time"
            return await asyncio.to_thread(figure.svg, 1160.0, 520.0, words)
    if not row.recording_id:
        return None
    path = await asyncio.to_thread(context.analyses.path, row.recording_id)
    recorded = await context.pool.submit("recorded", urgent=True, data=path).result
    figure = model_charts.recorded(recorded, plan_us, row.plan.get("pulse_rate_hz", 40.0), row.state)
    words = "Torque that was measured and pulses that were sent, over time"
    return await asyncio.to_thread(figure.svg, 1160.0, 460.0, words)
