"""The guided calibration on the page: plain forms, at the participant's pace; works with scripts off."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.sessions import profiles
from api.sessions.questions import Question, Row
from api.sessions.requests import CalibrationIn, MarkIn, StepIn
from api.store.tables import Participant
from api.web.dependencies import Context, Ctx, Tester
from api.web.pages import typed
from api.web.pages.checked import checked
from api.web.pages.render import page
from api.web.routes import calibration, participants
from rig.messages import Status

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/calibration")
DEFAULTS = CalibrationIn.model_validate({})
MARKS = {
    "sensory": ("It is felt", "the narrowest pulse the participant feels"),
    "motor": ("The muscle moves", "the narrowest pulse at which the muscle visibly moves"),
    "comfort": ("As strong as is comfortable", "no pulse of today's tests will be wider"),
}


@router.get("")
async def show(request: Request, context: Ctx, _who: Tester, code: str) -> Response:
    """Where the calibration stands; the form that begins one where none is open."""
    return await shown(request, context, code)


async def shown(
    request: Request, context: Context, code: str, texts: dict[str, str] | None = None,
    errors: dict[str, str] | None = None,
) -> Response:  # fmt: skip
    """The page, with the form as it was sent where something was wrong with it."""
    row = await asyncio.to_thread(participants.find, context, code)
    try:
        found: dict[str, Any] | None = await calibration.standing(context, code)
    except ApiError as error:
        if error.status != 404:
            raise
        found = None
    own = {"current_ma": typed.shown(row.profile["current_ma"]), "step_us": typed.shown(DEFAULTS.step_us)}
    limits = context.rig.status.limits if context.rig.status else {}
    return page(
        request, "calibration.html", 422 if errors else 200,
        participant=row, found=found, marks=MARKS,
        texts=texts or own, errors=errors or {},
        help={"current_ma": profiles.takes("current_ma", limits), "step_us": "1 to 25 µs"},
    )  # fmt: skip


@router.post("")
async def begin(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """Open one; a current that is far above the participant's is asked about first."""
    row = await asyncio.to_thread(participants.find, context, code)
    sent = await request.form()
    texts = {name: str(sent.get(name, ""))[:60] for name in ("current_ma", "step_us")}
    values, errors = read(texts, row, context.rig.status)
    if errors:
        return await shown(request, context, code, texts, errors)
    body, seen = checked(CalibrationIn, **values), profiles.version(row.profile)

    async def open_it() -> str:
        await calibration.begin(context, code, body, who.name, seen)
        return address(code)

    doubts = profiles.jumps(row.profile, {**row.profile, "current_ma": values["current_ma"]})
    if not doubts:
        return RedirectResponse(await open_it(), 303)
    current = f"{values['current_ma']:g} mA"
    question = Question(
        participant=code,
        title=f"Calibrate {code} with {current}?",
        button=f"Yes, calibrate with {current}",
        action=open_it,
        rows=[
            Row("Current of every pulse", current, f"{row.profile['current_ma']:g} mA"),
            Row("One step", f"{values['step_us']:g} µs"),
        ],
        warnings=doubts,
        back=address(code),
    )
    return RedirectResponse(context.questions.ask(question, who), 303)


def read(
    texts: dict[str, str], row: Participant, status: Status | None
) -> tuple[dict[str, float], dict[str, str]]:  # fmt: skip
    """The form's numbers, and what is wrong with it, a line a field."""
    values, errors = {}, {}
    for name, text in texts.items():
        try:
            values[name] = typed.number(text)
        except ValueError as error:
            errors[name] = str(error)
    if "step_us" in values and not (1 <= values["step_us"] <= 25):
        errors["step_us"] = f"{texts['step_us']!r} is not 1 to 25 µs"
    current = {name: value for name, value in values.items() if name == "current_ma"}
    limits = {name: bound for name, bound in (status.limits if status else {}).items() if name == "current_ma"}
    for name, words in profiles.outside(current, row.profile, limits).items():
        errors[name] = f"{texts[name]!r}: {words}"
    return values, errors


@router.post("/step/{direction}")
async def step(
    context: Ctx, _who: Tester, code: str, direction: str, trains: Annotated[str | None, Form()] = None
) -> Response:
    """Play one train; `trains`, how many the page knew of, says whether the train is still the one on its button."""
    wanted = checked(StepIn, direction=direction).direction
    if trains is not None:
        found = await calibration.standing(context, code)
        if trains != str(len(found["trains"])):
            detail = "Another train was sent after this page was shown. Nothing was sent now. Go back and check."
            raise ApiError(409, "not-what-was-seen", "This page is out of date", detail)
    await calibration.step(context, code, wanted)
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


def address(code: str) -> str:
    """The calibration's page."""
    return f"/participants/{code}/calibration"


def back(code: str) -> Response:
    """To the calibration's page."""
    return RedirectResponse(address(code), 303)
