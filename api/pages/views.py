"""What is looked at: a participant, a test."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response
from markupsafe import Markup

from api.context import Context, Ctx, LiveReader, Tester
from api.pages import charts
from api.pages.drawing import svg
from api.pages.model_view import measurement
from api.pages.render import page
from api.routes import participants, tests
from api.store.tables import Test

router = APIRouter(include_in_schema=False)


@router.get("/participants/{code}")
async def participant(request: Request, context: Ctx, _who: Tester, code: str) -> Response:
    """A participant: profile, start, history of tests and models."""

    def gather() -> dict[str, Any]:
        row = participants.find(context, code)
        history = context.store.all(Test, Test.participant == code, order=Test.requested_utc.desc(), limit=200)
        return {
            "participant": row,
            "now_utc": context.clock.utc(),
            "tests": [context.trials.public(test) for test in history],
            "models": [context.versions.public(model) for model in context.versions.of(code)],
        }

    return page(request, "participant.html", **await asyncio.to_thread(gather))


@router.get("/tests/{test_id}")
async def test(request: Request, context: Ctx, _who: LiveReader, test_id: str) -> Response:
    """A test: live while it runs, its outcome after."""
    row = await asyncio.to_thread(tests.find, context, test_id)
    document = await asyncio.to_thread(context.trials.public, row)
    planned = (row.plan.get("preview") or {}).get("pulse_width_us") or []
    data = {"test": document, "planned_us": planned, "pulse_rate_hz": row.plan.get("pulse_rate_hz", 40.0)}
    drawn = await measured(context, document["model_id"]) if document["model_id"] else None
    return page(request, "test.html", test=document, data=data, drawn=drawn)


async def measured(context: Context, model_id: str) -> Markup | None:
    """What was measured, with the model's free run, as a still picture; None where it cannot be had."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    found = await measurement(context, row)
    if found["curves"] is None:
        return None
    figure = charts.of_model(json.loads(row.document), found["curves"], found["comparison"])["comparison"]
    return svg(figure, 1160.0, 520.0, "Torque measured and predicted, what is left, and the pulse width, over time")
