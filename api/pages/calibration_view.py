"""The guided calibration on the page: plain forms, at the participant's pace; works with scripts off."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response
from pydantic import ValidationError

from api.context import Ctx, Tester
from api.errors import ApiError
from api.pages.render import page
from api.routes import calibration, participants
from api.schemas import CalibrationIn, MarkIn, StepIn

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/calibration")
MARKS = {
    "sensory": ("It is felt", "the narrowest pulse the participant feels"),
    "motor": ("The muscle moves", "the narrowest pulse at which the muscle visibly moves"),
    "comfort": ("As strong as is comfortable", "no pulse of today's tests will be wider"),
}


@router.get("")
async def show(request: Request, context: Ctx, _who: Tester, code: str) -> Response:
    """Where the calibration stands; the form that begins one where none is open."""
    row = await asyncio.to_thread(participants.find, context, code)
    try:
        found: dict[str, Any] | None = await calibration.standing(context, code)
    except ApiError as error:
        if error.status != 404:
            raise
        found = None
    return page(request, "calibration.html", participant=row, found=found, marks=MARKS, defaults=CalibrationIn())


@router.post("")
async def begin(
    context: Ctx, who: Tester, code: str, current_ma: Annotated[str, Form()] = "", step_us: Annotated[str, Form()] = ""
) -> Response:
    """Open one."""
    try:
        body = CalibrationIn.model_validate({"current_ma": current_ma, "step_us": step_us})
    except ValidationError as error:
        first = error.errors()[0]
        detail = f"{str(first['loc'][0]).replace('_', ' ')}: {first['msg']}, not {first['input']!r}. Nothing was sent."
        raise ApiError(422, "invalid-input", "The calibration cannot begin like this", detail) from None
    await calibration.begin(context, code, body, who.name)
    return back(code)


@router.post("/step/{direction}")
async def step(context: Ctx, _who: Tester, code: str, direction: str) -> Response:
    """Play one train."""
    await calibration.step(context, code, checked(StepIn, direction=direction).direction)
    return back(code)


@router.post("/mark/{threshold}")
async def mark(context: Ctx, who: Tester, code: str, threshold: str) -> Response:
    """Mark the last train's width."""
    await calibration.mark(context, code, checked(MarkIn, threshold=threshold).threshold, who.name)
    return back(code)


@router.post("/finish")
async def finish(context: Ctx, who: Tester, code: str) -> Response:
    """Take over what was found."""
    await calibration.finish(context, code, False, who.name)
    return RedirectResponse(f"/participants/{code}", 303)


@router.post("/discard")
async def discard(context: Ctx, who: Tester, code: str) -> Response:
    """Leave everything as it was."""
    await calibration.finish(context, code, True, who.name)
    return RedirectResponse(f"/participants/{code}", 303)


def checked(model: Any, **fields: str) -> Any:
    """A body from a path's words; 422 where they do not hold."""
    try:
        return model(**fields)
    except ValidationError as error:
        raise ApiError(422, "invalid-input", "This cannot be done", str(error.errors()[0]["msg"])) from None


def back(code: str) -> Response:
    """To the calibration's page."""
    return RedirectResponse(f"/participants/{code}/calibration", 303)
