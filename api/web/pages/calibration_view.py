"""The guided calibration on the page: plain forms, at the participant's pace; works with scripts off.

What goes wrong is said on the page itself, above the buttons, with the calibration as it stands now.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.services import calibrations, participants
from stimrig.api.sessions import profiles
from stimrig.api.sessions.questions import Question, Row
from stimrig.api.sessions.requests import CalibrationIn, MarkIn, StepIn
from stimrig.api.store.tables import Participant
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.render import done_or_said, page
from stimrig.rig.messages import Status

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/calibration")
DEFAULTS = CalibrationIn.model_validate({})
MARKS = {
    "sensory": ("It is felt", "the narrowest pulse the participant feels"),
    "motor": ("The muscle moves", "the narrowest pulse at which the muscle visibly moves"),
    "comfort": ("As strong as is comfortable", "no pulse of today's tests will be wider"),
}
LAST = {"sensory": "sensory_pulse_width_us", "motor": "motor_pulse_width_us", "comfort": "max_pulse_width_us"}
FINE_US = (1.0, 25.0)
"""The narrowest and the widest fine step where the rig has not said."""


@router.get("")
async def show(request: Request, context: Ctx, _who: Tester, code: str) -> Response:
    """Where the calibration stands; the form that begins one where none is open."""
    return await show_page(request, context, code)


async def show_page(
    request: Request, context: Context, code: str, texts: dict[str, str] | None = None,
    errors: dict[str, str] | None = None, problem: ApiError | None = None,
) -> Response:  # fmt: skip
    """The page, with the form as it was sent where something was wrong with it, and what just went wrong."""
    row = await asyncio.to_thread(participants.find, context, code)
    try:
        found: dict[str, Any] | None = await calibrations.standing(context, code)
    except ApiError as error:
        if error.status != 404:
            raise
        found = None
    kept = context.rig.status.calibrated if context.rig.status and found is None else None
    waits = kept if kept is not None and kept.participant == code else None
    limits = context.rig.status.limits if context.rig.status else {}
    low_us, high_us = fine_range(context.rig.status)
    status = problem.status if problem else 422 if errors else 200
    return page(
        request, "calibration.html", status,
        participant=row, found=found, waits=waits, marks=MARKS, last=last(row.profile), problem=problem,
        texts=texts or usual(row), errors=errors or {},
        help={"current_ma": profiles.takes("current_ma", limits), "step_us": f"{low_us:g} to {high_us:g} µs"},
    )  # fmt: skip


def usual(row: Participant) -> dict[str, str]:
    """The participant's own current and the usual fine step: what holds where a form has neither."""
    first = row.profile["current_ma"]
    return {"current_ma": typed.number_text(first), "step_us": typed.number_text(DEFAULTS.step_us)}


def last(profile: Mapping[str, Any]) -> dict[str, float]:
    """Marks of the last calibration, µs; empty where there is none."""
    if profile.get("sensory_pulse_width_us") is None:
        return {}
    return {name: profile[field] for name, field in LAST.items()}


def fine_range(status: Status | None) -> tuple[float, float]:
    """The narrowest and the widest fine step of this rig, µs."""
    bound = status.limits.get("calibration_step_us") if status else None
    if bound is None or bound.lo is None or bound.hi is None:
        return FINE_US
    return bound.lo, bound.hi


async def attempt(request: Request, context: Context, code: str, done: Awaitable[Any], leads: str) -> Response:
    """Do it and go on; what the rig or the service refuses is said on the page."""
    return await done_or_said(done, lambda problem: show_page(request, context, code, problem=problem), leads)


@router.post("")
async def begin(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """Open one; a current that is far above the participant's is asked about first."""
    row = await asyncio.to_thread(participants.find, context, code)
    sent = await request.form()
    texts = {name: str(sent.get(name, text))[:60] for name, text in usual(row).items()}
    values, errors = read(texts, row, context.rig.status)
    if errors:
        return await show_page(request, context, code, texts, errors)
    body = typed.checked(CalibrationIn, **values, large_steps=True)

    async def open_it() -> str:
        await calibrations.begin(context, code, body, who.name)
        return address(code)

    doubts = profiles.jumps(row.profile, {**row.profile, "current_ma": values["current_ma"]})
    if not doubts:
        return await attempt(request, context, code, open_it(), address(code))
    current = f"{values['current_ma']:g} mA"
    question = Question(
        participant=code,
        title=f"Calibrate {code} with {current}?",
        button=f"Yes, calibrate with {current}",
        action=open_it,
        rows=[
            Row("Current of every pulse", current, f"{row.profile['current_ma']:g} mA"),
            Row("Fine step", f"{values['step_us']:g} µs"),
        ],
        warnings=doubts,
        back=address(code),
    )
    return RedirectResponse(context.questions.ask(question, who), 303)


def read(
    texts: dict[str, str], row: Participant, status: Status | None
) -> tuple[dict[str, float], dict[str, str]]:  # fmt: skip
    """The form's numbers, and what is wrong with it, a line a field."""
    values, errors = typed.numbers(texts)
    low_us, high_us = fine_range(status)
    if "step_us" in values and not (low_us <= values["step_us"] <= high_us):
        errors["step_us"] = f"{texts['step_us']!r} is not {low_us:g} to {high_us:g} µs"
    limits = {name: bound for name, bound in (status.limits if status else {}).items() if name == "current_ma"}
    if "current_ma" in values:
        for words in profiles.outside({"current_ma": values["current_ma"]}, row.profile, limits).values():
            errors["current_ma"] = f"{texts['current_ma']!r}: {words}"
    return values, errors


@router.post("/step/{direction}")
async def step(
    request: Request, context: Ctx, _who: Tester, code: str, direction: str,
    shown_us: Annotated[float | None, Form()] = None,
) -> Response:  # fmt: skip
    """Play one train; the trains that the page knew of and the width on the button say whether both still hold."""
    body = typed.checked(StepIn, direction=direction, shown_us=shown_us)
    done = calibrations.step(context, code, body)
    return await attempt(request, context, code, done, address(code))


@router.post("/mark/{threshold}")
async def mark(request: Request, context: Ctx, who: Tester, code: str, threshold: str) -> Response:
    """Mark the last train's width."""
    body = typed.checked(MarkIn, threshold=threshold)
    done = calibrations.mark(context, code, body, who.name)
    return await attempt(request, context, code, done, address(code))


@router.post("/finish")
async def finish(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """Take over what was found."""
    done = calibrations.close(context, code, who.name, None)
    return await attempt(request, context, code, done, f"/participants/{code}")


@router.post("/discard")
async def discard(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """Leave everything as it was; however many trains were sent."""
    done = calibrations.close(context, code, who.name, None, discard=True)
    return await attempt(request, context, code, done, f"/participants/{code}")


def address(code: str) -> str:
    """The calibration's page."""
    return f"/participants/{code}/calibration"
