"""A participant: limits for today and the way to a test in one form, models and tests below; questions before it."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import RedirectResponse, Response
from markupsafe import Markup
from starlette.datastructures import FormData

from stimrig.api.errors import ApiError
from stimrig.api.people import controller_keys
from stimrig.api.people.auth import Principal
from stimrig.api.sessions import profiles
from stimrig.api.sessions.questions import LIFE_S, Question, Row, gone
from stimrig.api.sessions.requests import LEAST_PERCENT, MOST_PERCENT, TargetIn, TestIn
from stimrig.api.store import seen
from stimrig.api.store.tables import Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import limits_form, next_view, starting, trials_view, typed
from stimrig.api.web.pages.limits_form import LimitsForm
from stimrig.api.web.pages.render import page
from stimrig.api.web.routes import participants, recordings

router = APIRouter(include_in_schema=False, prefix="/participants/{code}")


@router.get("")
async def participant(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """A participant: limits, start, history of tests and models."""
    return await shown(request, context, who, code)


async def shown(
    request: Request, context: Context, who: Principal, code: str, form: LimitsForm | None = None, status: int = 200,
    made: dict[str, Any] | None = None,
) -> Response:  # fmt: skip
    """The page, with the form as it was sent where something was wrong with it.

    `made`: a controller's key that was just made, the only time its text is seen.
    """

    def gather() -> dict[str, Any]:
        row = participants.find(context, code)
        history = context.store.all(Test, Test.participant == code, order=Test.requested_utc.desc(), limit=200)
        return {
            "participant": row,
            "notes": context.notes.of(code),
            "calibrated": starting.calibrated(context, row),
            "step": next_view.step(context, row),
            "form": form or limits_form.fresh(row.profile, context.rig.status),
            "meanwhile": participants.meanwhile(context, code),
            "fields": limits_form.fields(context.rig.status),
            "tests": [context.runner.document(test) for test in history],
            "models": context.versions.of(code),
            "keys": controller_keys.of(context.auth, code),
            "made": made,
            "trials": trials_of(context, who, code),
            "sensor": limits_form.has_sensor(context.rig.status),
        }

    return page(request, "participant.html", status, **await asyncio.to_thread(gather))


def trials_of(context: Context, who: Principal, code: str) -> Markup | None:
    """The card of the trials; empty before the first one, None where no model may be tracked."""
    found = trials_view.card(context, code)
    return None if found is None else Markup(trials_view.drawn(context, who, code, found))


@router.post("/profile")
async def set_limits(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """The limits for the day."""
    return await taken(request, context, who, code, start=False)


@router.post("/tests")
async def start_test(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """To the question before the pre-session test; limits that were typed are set on the way, or asked about."""
    return await taken(request, context, who, code, start=True)


async def taken(request: Request, context: Context, who: Principal, code: str, start: bool) -> Response:
    """Take the form: refuse it, ask about it, or do what it says."""
    row = await asyncio.to_thread(participants.find, context, code)
    status = context.rig.status
    sent = await request.form()
    form = limits_form.read(sent, row.profile, status)
    if form.errors:
        return await shown(request, context, who, code, form, 422)
    wanted = asked_test(sent, code) if start else None

    async def on() -> str:
        if wanted is None:
            return f"/participants/{code}"
        return await starting.ask(context, who, wanted)

    if not form.asked:
        return RedirectResponse(await on(), 303)
    await asyncio.to_thread(context.store.refuse_changed, seen.participant(code))
    new, voids = profiles.changed(row.profile, form.asked)

    async def save() -> str:
        _row, place = await participants.change_profile(context, code, form.asked, who.name, bool(voids))
        seen.looked.set(place)  # what is asked next rests on what was just decided
        return await on()

    doubts = [*profiles.jumps(row.profile, new), *_lost(context, voids)]
    if not doubts:
        return RedirectResponse(await save(), 303)
    return RedirectResponse(context.questions.ask(_question(row, new, doubts, save), who), 303)


def _question(row: Participant, new: dict[str, Any], doubts: list[str], save: Any) -> Question:
    lines, values = [], []
    for name, limit in profiles.LIMITS.items():
        value, before = f"{new[name]:g} {limit.unit}", f"{row.profile[name]:g} {limit.unit}"
        lines.append(Row(limit.words.capitalize(), value, before if before != value else ""))
        values.append(value)
    if (range_rad := profiles.range_of(new)) is not None:
        now, was = profiles.range_words(range_rad), profiles.range_of(row.profile)
        before = profiles.range_words(was) if was else "–"
        lines.append(Row("Joint angles", now, before if before != now else ""))
    return Question(
        participant=row.code,
        title=f"Set these limits for {row.code}?",
        button=f"Yes, set {', '.join(values)}",
        action=save,
        rows=lines,
        warnings=doubts,
    )


def _lost(context: Context, voids: str) -> list[str]:
    if not voids:
        return []
    required = context.rig.status is None or context.rig.status.require_calibration is not False
    then = " Until the participant is calibrated anew, no test starts." if required else ""
    return [f"The calibration is lost with it: {voids}.{then}"]


def asked_test(sent: FormData, code: str) -> TestIn:
    """The test that a person asks for; one that stops itself is asked about whether or not its target is in reach.

    Raises
    ------
    ApiError
        422: what was typed is no target.
    """
    if sent.get("plan") != "adaptive":
        return TestIn(participant=code)
    percent = typed.wanted(str(sent.get("target") or ""), no_target)
    if not (LEAST_PERCENT <= percent <= MOST_PERCENT):
        within = f"{percent:g} % is not from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %"
        raise typed.unusable(no_target(within))
    target = TargetIn(curve_percent=percent, step_percent=percent)
    return TestIn(participant=code, kind="adaptive", target=target, anyway=True)


def no_target(why: str) -> str:
    """Why there is no target."""
    return f"Target: {why}. Nothing was started."


@router.get("/confirm/{number}")
async def question(request: Request, context: Ctx, who: Tester, code: str, number: str) -> Response:
    """The question; or, where it has been answered, what came of it."""
    asked = context.questions.find(code, number, who)
    if asked.answer is None:
        return page(request, "question.html", question=asked, minutes=LIFE_S / 60)
    if asked.answer.done() and asked.answer.exception() is None:
        return RedirectResponse(asked.answer.result(), 303)
    raise gone("It has been answered.")


@router.post("/confirm/{number}")
async def answer(context: Ctx, who: Tester, code: str, number: str) -> Response:
    """Yes."""
    asked = context.questions.find(code, number, who)
    return RedirectResponse(await context.questions.yes(asked), 303)


@router.post("/recordings")
async def upload(
    context: Ctx, who: Tester, code: str, file: Annotated[UploadFile, File()], of: Annotated[str, Form()] = ""
) -> Response:  # fmt: skip
    """A recording of another tool, CSV or HDF5; leads to the model made from it."""
    await asyncio.to_thread(participants.find, context, code)
    data = await file.read()
    if not data:
        raise ApiError(422, "empty", "No file came", "Go back and choose a CSV file or a sealed recording (HDF5).")
    _row, model, _warnings = await recordings.take_in(context, code, data, who, of=of)
    return RedirectResponse(f"/models/{model.id}", 303)
