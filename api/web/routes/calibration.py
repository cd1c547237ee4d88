"""The participant's profile, found in a guided calibration: one short train for each step a person asks for."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from stimrig.api.services import calibrations
from stimrig.api.sessions.requests import CalibrationIn, MarkIn, StepIn
from stimrig.api.web.dependencies import PROBLEM, CalibrationVersion, Ctx, ParticipantDecision, Tester
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.people import CalibratedOut, CalibrationOut

router = APIRouter(prefix="/v1/participants/{code}/calibration", tags=["calibration"], responses=PROBLEM)


@router.post("", status_code=201, **describe_answer(CalibrationOut, 201, "open; nothing was sent yet"))
async def begin_calibration(
    context: Ctx, code: str, decision: ParticipantDecision, response: Response, body: CalibrationIn | None = None
) -> dict[str, Any]:
    """Open a guided calibration: nothing is sent until a step is asked for."""
    body = body or CalibrationIn.model_validate({})
    return tagged(response, await calibrations.begin(context, code, body, decision))


@router.get("", **describe_answer(CalibrationOut))
async def calibration(context: Ctx, _principal: Tester, code: str, response: Response) -> dict[str, Any]:
    """Where it stands: width, ceiling and whose it is, marks, what is missing, every train."""
    return tagged(response, await calibrations.standing(context, code))


def tagged(response: Response, calibration: dict[str, Any]) -> dict[str, Any]:
    """Return where a calibration stands, with its version as `ETag`."""
    response.headers["ETag"] = f'"{calibration["version"]}"'
    return calibration


@router.post("/step", status_code=202, **describe_answer(CalibrationOut, 202, "the train is on its way"))
async def play_step(
    context: Ctx, _principal: Tester, code: str, tags: CalibrationVersion, body: StepIn, response: Response
) -> dict[str, Any]:
    """Play one train: wider (`up`, or `fine` by a fine step), narrower, or the same again.

    It is over when `playing` is false again.
    """
    return tagged(response, await calibrations.step(context, code, body, tags))


@router.post("/mark", **describe_answer(CalibrationOut))
async def set_mark(
    context: Ctx, principal: Tester, code: str, tags: CalibrationVersion, body: MarkIn, response: Response
) -> dict[str, Any]:
    """Mark the last train's width as a threshold; marking again replaces."""
    return tagged(response, await calibrations.mark(context, code, body, principal.name, tags))


@router.post("/finish", **describe_answer(CalibratedOut))
async def finish_calibration(context: Ctx, principal: Tester, code: str, tags: CalibrationVersion) -> dict[str, Any]:
    """Close it: the profile holds until the end of the day. The participant has another version then."""
    return await calibrations.close(context, code, principal.name, tags)


@router.post("/discard", **describe_answer(CalibratedOut))
async def discard_calibration(context: Ctx, principal: Tester, code: str, tags: CalibrationVersion) -> dict[str, Any]:
    """Close it and keep the profile of before; however many trains were sent."""
    return await calibrations.close(context, code, principal.name, tags, discard=True)
