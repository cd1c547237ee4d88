"""The angle sensor on a page: what it reads now, and its calibration by two poses with a goniometer."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.store.seen import ChangedError
from api.web.dependencies import Context, Ctx, Tester
from api.web.pages import angle_form
from api.web.pages.checked import checked
from api.web.pages.render import page
from api.web.routes import joint
from api.web.routes.joint import PoseIn

router = APIRouter(include_in_schema=False, prefix="/rig/angle")


@router.get("")
async def show(request: Request, context: Ctx, _who: Tester, again: str = "") -> Response:
    """What it reads now, how it was calibrated, and the next pose; `again`: the first one once more."""
    return await shown(request, context, again=bool(again))


async def shown(
    request: Request, context: Context, text: str = "", error: str = "", problem: ApiError | None = None,
    again: bool = False,
) -> Response:  # fmt: skip
    """The page, with what was typed where something was wrong with it."""
    if context.rig.connected:
        await context.rig.fresh_status()
    sensor = joint.sensor(context)
    second = sensor.pose is not None and not again
    status = problem.status if problem else 422 if error else 200
    values: dict[str, Any] = {"sensor": sensor, "second": second, "text": text, "error": error, "problem": problem}
    return page(request, "angle.html", status, **values)


@router.post("/pose")
async def take_pose(request: Request, context: Ctx, who: Tester) -> Response:
    """Take a pose: the angle that a goniometer shows, in degrees."""
    sent = await request.form()
    text, first = str(sent.get("angle_deg") or "")[:60], bool(sent.get("first"))
    try:
        angle_rad = angle_form.of_pose(text, context.rig.status)
    except ValueError as error:
        return await shown(request, context, text, str(error), again=first)
    body = checked(PoseIn, angle_rad=angle_rad, first=first)
    try:
        await joint.take_pose(context, body, who.name)
    except ChangedError:  # it has a page of its own
        raise
    except ApiError as error:
        words = error.detail.removeprefix("angle_pose: ")
        error.detail = words[:1].upper() + words[1:]
        return await shown(request, context, text, problem=error, again=first)
    return RedirectResponse("/rig/angle", 303)
