"""The rig: its state, stop at any time, and re-arming by a person."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.services import rig as services
from stimrig.api.sessions.requests import StopIn, TestIn
from stimrig.api.sessions.stops import StopResult
from stimrig.api.web.dependencies import PROBLEM, Anyone, Ctx, LatchVersion, LiveReader, MayStop, Rearmer, Tester
from stimrig.api.web.middleware import wants_html
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.rig import PreviewOut, RigOut, SequencesOut, StoppedOut
from stimrig.rig.messages import StopEvidence
from stimrig.rig.requests import SequencesRequest

router = APIRouter(prefix="/v1", tags=["rig"], responses=PROBLEM)
FORM = {"schema": StopIn.model_json_schema()}
STOP = {"requestBody": {"content": {"application/json": FORM, "application/x-www-form-urlencoded": FORM}}}


@router.get("/rig", **describe_answer(RigOut))
def rig(context: Ctx, _principal: LiveReader, response: Response) -> dict[str, Any]:
    """State, devices, newest torque and its age. `ETag` names the last stop: a re-arm says which one it answers."""
    response.headers["ETag"] = f'"{context.rig.status.latch if context.rig.status else ""}"'
    return services.rig_state(context)


@router.get("/sequences", **describe_answer(SequencesOut))
async def sequences(context: Ctx, _principal: Anyone) -> dict[str, Any]:
    """List this rig's sequences with their settings, units and ranges, its protocols, and the default test."""
    return await context.rig.ask(SequencesRequest())


@router.post("/stop", **describe_answer(StoppedOut, description="stopped, by the rig's evidence"), openapi_extra=STOP)
async def stop(request: Request, context: Ctx, press: MayStop) -> Response:
    """Stop stimulation: anyone signed in, and any page that shows the button; JSON, a plain form, or no body at all.

    200 only on the rig's evidence that stimulation has stopped; otherwise a problem that says so.
    """
    test_id = context.runner.current.test_id if context.runner.current else None
    answer: StopEvidence | ApiError
    try:
        answer = await context.stops.stop(press.reason, press.by, test_id or "rig")
    except ApiError as error:
        answer = error
    if wants_html(request):  # a page of the result, which can be loaded again and stops nothing
        right = getattr(request.state, "stop_right", None)
        result = StopResult(press.by, press.reason, context.clock.utc(), test_id, right, answer)
        return RedirectResponse(f"/stopped/{context.stops.add(result)}", 303)
    if isinstance(answer, ApiError):
        raise answer
    rig = {} if press.by_key else {"rig": services.rig_state(context)}
    return JSONResponse({"stopped": answer.confirmed, "evidence": answer.model_dump(), **rig})


@router.post("/rearm", **describe_answer(RigOut))
async def rearm(context: Ctx, principal: Rearmer, tags: LatchVersion, response: Response) -> dict[str, Any]:
    """After a stop, a fault or a restart the rig stays still until a person re-arms it: who signed in with a password.

    A program needs the scope `rearm`, which `run-test` does not imply and no controller's key holds.
    """
    status = await services.rearm(context, principal.name, tags)
    response.headers["ETag"] = f'"{status.latch}"'
    return services.rig_state(context)


@router.post("/preview", **describe_answer(PreviewOut))
async def preview(context: Ctx, _principal: Tester, body: TestIn) -> Response:
    """A test's duration, dose and pulse widths, without playing it. 503 where too many are asked for at once."""
    return JSONResponse(await context.runner.preview(body))
