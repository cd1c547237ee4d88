"""The guided tests of a joint that moves: what was done, what is next, one model of all; and the angle sensor."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.models import together
from stimrig.api.services import joint, participants
from stimrig.api.services.joint import PoseIn, TogetherIn
from stimrig.api.sessions import profiles
from stimrig.api.sessions.joint import target_of
from stimrig.api.sessions.joint_plan import HELD, KINDS, MOVING, PASSIVE
from stimrig.api.sessions.requests import AngleIn, TestIn
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store.tables import Participant, Test
from stimrig.api.web.dependencies import Context, Ctx, Tester
from stimrig.api.web.pages import limits_form, starting, typed
from stimrig.api.web.pages.render import done_or_said, page

router = APIRouter(include_in_schema=False)
OF_PERSON = "/participants/{code}/joint"
ISOMETRIC = ("pre-session", "adaptive", "next-experiment")
"""Kinds of tests in which the joint stands still at the angle of the fixture."""


@router.get(OF_PERSON)
async def show(request: Request, context: Ctx, _who: Tester, code: str) -> Response:
    """Sensor, range, the three kinds of tests with what is open, and the recordings of today."""
    row = await asyncio.to_thread(participants.find, context, code)
    problem = None
    try:
        found = await joint.overview_of(context, row)
    except ApiError as error:
        problem, found = error, {"sensor": joint.sensor(context).model_dump(), "range_rad": None, **joint.NOTHING_OPEN}
    gathered = await asyncio.to_thread(_gather, context, row, found)
    return page(request, "joint.html", participant=row, found=found, problem=problem, **gathered)


def _gather(context: Context, row: Participant, found: dict[str, Any]) -> dict[str, Any]:
    conditions = (
        Test.participant == row.code, Test.state == "completed", Test.recording_id.is_not(None), Test.kind != SEQUENCE,
        Test.requested_utc >= context.clock.start_of_day_utc(),
    )  # fmt: skip
    rows = context.store.all(Test, *conditions, order=Test.requested_utc)
    picked = _picked(rows)
    return {
        "range_rad": profiles.range_of(row.profile),
        "may_start": starting.calibrated(context, row).may_start,
        "archived": row.archived_utc is not None,
        "held": [{**each, "deg": starting.allowed_deg({"target_rad": each["angle_rad"]})} for each in found["targets"]],
        "allowed": None if found["next_rad"] is None else starting.allowed_deg({"target_rad": found["next_rad"]}),
        "recordings": [{"test": test, "picked": test.id in picked, "target_rad": target_of(test)} for test in rows],
        "kinds_lacking": [kind for kind in (PASSIVE, HELD, MOVING) if not any(test.kind == kind for test in rows)],
    }


def _picked(rows: list[Test]) -> set[str]:
    """The newest isometric, passive and moving one, and the newest at each angle that was held."""
    newest: dict[str, str] = {}
    for test in rows:
        angle = f"{target_of(test):.1f}" if test.kind == HELD else ""
        newest[("isometric" if test.kind in ISOMETRIC else test.kind) + angle] = test.id
    return set(newest.values())


@router.post(OF_PERSON + "/tests")
async def start_test(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """To the question before a guided test."""
    sent = await request.form()
    kind = str(sent.get("kind") or "")
    if kind not in KINDS:
        raise typed.unusable("kind: choose one of the three tests.")
    more: dict[str, Any] = {}
    if kind == HELD and (text := str(sent.get("target_rad") or "")):
        more["angle"] = typed.checked(AngleIn, target_rad=_number(text))
    body = typed.checked(TestIn, participant=code, kind=kind, **more)
    return RedirectResponse(await starting.ask(context, who, body, back=f"/participants/{code}/joint"), 303)


def _number(text: str) -> float:
    """An angle as this page itself wrote it, rad."""
    try:
        return float(text[:20])
    except ValueError:
        detail = f"target_rad: {text[:20]!r} is no angle. Go back and press the button of an angle."
        raise typed.unusable(detail) from None


@router.post(OF_PERSON + "/model")
async def fit_together(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """One model of the recordings that are ticked."""
    await asyncio.to_thread(participants.find, context, code)
    sent = await request.form()
    chosen = [str(each)[:80] for each in sent.getlist("recording")]
    if not chosen:
        raise ApiError(422, "invalid-input", "No recording is ticked", "Go back and tick those that belong together.")
    body = typed.checked(TogetherIn, recordings=chosen, effects=list(together.JOINT_EFFECTS))
    return RedirectResponse(f"/jobs/{joint.begin_fit(context, code, body, who.name).id}", 303)


@router.get("/rig/angle")
async def show_sensor(request: Request, context: Ctx, _who: Tester, again: str = "") -> Response:
    """What it reads now, how it was calibrated, and the next pose; `again`: the first one once more."""
    return await sensor_page(request, context, again=bool(again))


async def sensor_page(
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


@router.post("/rig/angle/pose")
async def take_pose(request: Request, context: Ctx, who: Tester) -> Response:
    """Take a pose: the angle that a goniometer shows, in degrees."""
    sent = await request.form()
    text, first = str(sent.get("angle_deg") or "")[:60], bool(sent.get("first"))
    try:
        angle_rad = limits_form.read_pose(text, context.rig.status)
    except ValueError as error:
        return await sensor_page(request, context, text, str(error), again=first)
    body = typed.checked(PoseIn, angle_rad=angle_rad, first=first)

    async def said(problem: ApiError) -> Response:
        words = problem.detail.removeprefix("angle_pose: ")
        problem.detail = words[:1].upper() + words[1:]
        return await sensor_page(request, context, text, problem=problem, again=first)

    return await done_or_said(joint.take_pose(context, who.name, body), said, "/rig/angle")
