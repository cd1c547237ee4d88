"""The rig: its state, stop at any time, and re-arming by a person."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from api import audit
from api.context import PROBLEM, Context, Ctx, LiveReader, MayStop, Tester
from api.errors import ApiError
from api.schemas import StopIn, TestIn
from rig.messages import RearmRequest

router = APIRouter(prefix="/v1", tags=["rig"], responses=PROBLEM)


def rig_state(context: Context) -> dict[str, Any]:
    """What is known of the rig, and how old it is."""
    status = context.rig.status
    current = context.trials.current
    return {
        "connected": context.rig.connected,
        "age_s": context.rig.age_s,
        **(
            status.model_dump(exclude={"finished"})
            if status
            else {"state": "disconnected", "reason": "the rig has not spoken yet"}
        ),
        "holder": {"test_id": current.test_id, "participant": current.participant, "by": current.by}
        if current
        else None,
    }


@router.get("/rig")
def rig(context: Ctx, _who: LiveReader) -> dict[str, Any]:
    """State, devices, newest torque and its age."""
    return rig_state(context)


@router.post("/stop")
async def stop(request: Request, context: Ctx, who: MayStop) -> Response:
    """Stop stimulation: anyone signed in, at any time; JSON, a plain form, or no body at all.

    200 only on the rig's evidence that stimulation has stopped; otherwise a problem that says so.
    """
    reason = await _reason(request, patience_s=0.5)
    evidence = await context.trials.stop(reason, who.name)
    from api.pages.render import stop_page, wants_html

    if wants_html(request):
        return stop_page(request, evidence)
    return JSONResponse({"stopped": evidence.confirmed, "evidence": evidence.model_dump(), "rig": rig_state(context)})


async def _reason(request: Request, patience_s: float) -> str:
    """The stated reason; whatever the body holds, and however slowly it comes, a stop is a stop."""
    default = "stop pressed"
    try:
        async with asyncio.timeout(patience_s):
            return await _stated(request, default)
    except (ValidationError, ValueError, ApiError, HTTPException, TimeoutError, ClientDisconnect):
        return default


async def _stated(request: Request, default: str) -> str:
    if "form" in request.headers.get("content-type", ""):
        return str((await request.form()).get("reason") or default)[:200]
    body = await request.body()
    return StopIn.model_validate_json(body).reason if body.strip() else default


async def rearm_rig(context: Context, by: str) -> dict[str, Any]:
    """A person has looked and lets the rig work again."""

    def note() -> None:
        with context.store.write() as session:
            audit.write(session, context.clock.utc(), by, "re-arm", "rig")

    await asyncio.to_thread(note)
    await context.rig.ask(RearmRequest(by=by))
    await context.rig.fresh_status()
    return rig_state(context)


@router.post("/rearm")
async def rearm(context: Ctx, who: Tester) -> dict[str, Any]:
    """After a stop, a fault or a restart the rig stays still until a person re-arms it."""
    return await rearm_rig(context, who.name)


@router.post("/preview")
async def preview(context: Ctx, _who: Tester, body: TestIn) -> dict[str, Any]:
    """A test's duration, dose and pulse widths, without playing it."""
    return await context.trials.preview(body)
