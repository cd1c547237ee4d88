"""The guided calibration on the page: one press, one train, at the participant's pace."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.errors import ApiError
from stimrig.api.services import calibrations, participants
from stimrig.api.sessions import profiles
from stimrig.api.sessions.requests import CalibrationIn
from stimrig.api.web.dependencies import Ctx, Tester
from stimrig.api.web.pages.limits_form import number_text
from stimrig.api.web.pages.render import page
from stimrig.rig.messages import Status

router = APIRouter(include_in_schema=False)
DEFAULTS = CalibrationIn.model_validate({})
MARKS = {
    "sensory": ("It is felt", "the narrowest pulse the participant feels"),
    "motor": ("The muscle moves", "the narrowest pulse at which the muscle visibly moves"),
    "comfort": ("As strong as is comfortable", "no pulse of today's tests will be wider"),
}
LAST = {"sensory": "sensory_pulse_width_us", "motor": "motor_pulse_width_us", "comfort": "max_pulse_width_us"}
FINE_US = (1.0, 25.0)
"""The narrowest and the widest fine step where the rig has not said."""


@router.get("/participants/{code}/calibration")
async def show(request: Request, context: Ctx, _principal: Tester, code: str) -> Response:
    """Show where the calibration stands, or the form that begins one."""
    row = await asyncio.to_thread(participants.find, context, code)
    try:
        standing: dict[str, Any] | None = await calibrations.standing(context, code)
    except ApiError as error:
        if error.status != 404:
            raise
        standing = None
    status = context.rig.status
    finished = status.calibrated if status and standing is None else None
    waits = finished if finished is not None and finished.participant == code else None
    low_us, high_us = fine_range(status)
    texts = {"current_ma": number_text(row.profile["current_ma"]), "step_us": number_text(DEFAULTS.step_us)}
    help_texts = {
        "current_ma": profiles.range_help("current_ma", status.limits if status else {}),
        "step_us": f"{low_us:g} to {high_us:g} µs",
    }
    return page(
        request, "calibration.html", participant=row, calibration=standing, waits=waits, marks=MARKS,
        last=last(row.profile), texts=texts, help=help_texts,
    )  # fmt: skip


def last(profile: Mapping[str, Any]) -> dict[str, float]:
    """Return the marks of the last calibration, µs; empty where there is none."""
    if profile.get("sensory_pulse_width_us") is None:
        return {}
    return {name: profile[field] for name, field in LAST.items()}


def fine_range(status: Status | None) -> tuple[float, float]:
    """Return the narrowest and the widest fine step of this rig, µs."""
    bound = status.limits.get("calibration_step_us") if status else None
    if bound is None or bound.lo is None or bound.hi is None:
        return FINE_US
    return bound.lo, bound.hi
