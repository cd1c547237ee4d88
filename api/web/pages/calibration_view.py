"""The guided calibration on the page: one press, one train, at the participant's pace."""

from __future__ import annotations

import asyncio
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
from stimrig.rig.messages import Bound

router = APIRouter(include_in_schema=False)
DEFAULTS = CalibrationIn.model_validate({})
MARKS = {
    "sensory": ("It is felt", "the narrowest pulse the participant feels"),
    "motor": ("The muscle moves", "the narrowest pulse at which the muscle visibly moves"),
    "comfort": ("As strong as is comfortable", "no pulse of today's tests will be wider"),
}
LAST = {"sensory": "sensory_pulse_width_us", "motor": "motor_pulse_width_us", "comfort": "max_pulse_width_us"}
FINE = Bound(lo=1.0, hi=25.0, unit="µs", owner="any rig's")
"""The fine step where the rig has not said what it takes."""


@router.get("/participants/{code}/calibration")
async def show(request: Request, context: Ctx, _principal: Tester, code: str) -> Response:
    """Show where the calibration stands, or the form that begins one."""
    row = await asyncio.to_thread(participants.find, context, code)
    standing: dict[str, Any] | None = None
    try:
        standing = await calibrations.standing(context, code)
    except ApiError as error:
        if error.status != 404:
            raise
    status, profile = context.rig.status, row.profile
    finished, bounds = (status.calibrated, status.limits) if status else (None, {})
    waits = finished if standing is None and finished is not None and finished.participant == code else None
    fine = bounds.get("calibration_step_us", FINE)
    texts = {"current_ma": number_text(profile["current_ma"]), "step_us": number_text(DEFAULTS.step_us)}
    help_texts = {
        "current_ma": profiles.range_help("current_ma", bounds),
        "step_us": f"{fine.lo:g} to {fine.hi:g} µs",
    }
    last = {name: profile[field] for name, field in LAST.items()} if profile.get(LAST["sensory"]) is not None else {}
    return page(
        request, "calibration.html", participant=row, calibration=standing, waits=waits, marks=MARKS, last=last,
        texts=texts, help=help_texts,
    )  # fmt: skip
