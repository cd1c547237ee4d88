"""What is looked at: a participant, a test."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from api.context import Ctx, LiveReader, Tester
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
    return page(request, "test.html", test=document, data=data)
