"""A participant: limits for today and the way to a test in one form, models and tests below; questions before it."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from markupsafe import Markup
from starlette.datastructures import FormData

from stimrig.api.charts import trend_charts
from stimrig.api.clock import unix_of
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.local_time import clock
from stimrig.api.models.places import site_of
from stimrig.api.models.tracking import OUTCOMES, Limits, sentences
from stimrig.api.people.auth import Principal
from stimrig.api.services import keys, notes, participants, recordings
from stimrig.api.sessions import controllers, profiles
from stimrig.api.sessions.questions import LIFE_S, Question, Row, gone
from stimrig.api.sessions.requests import LEAST_PERCENT, MOST_PERCENT, MuscleIn, NoteIn, TargetIn, TestIn
from stimrig.api.store import locking
from stimrig.api.store.tables import Recording
from stimrig.api.web.dependencies import Approver, Context, Ctx, Tester
from stimrig.api.web.guards import local
from stimrig.api.web.pages import limits_form, next_view, render, starting, typed
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.limits_form import LimitsForm
from stimrig.api.web.pages.render import page, signed
from stimrig.api.web.pages.starting import site_words
from stimrig.api.web.pages.typed import Text
from stimrig.rig.messages import LABEL_TITLES

router = APIRouter(include_in_schema=False, prefix="/participants/{code}")


@router.get("")
async def participant(request: Request, context: Ctx, who: Tester, code: str) -> Response:
    """A participant: limits, start, history of tests and models."""
    return await show_page(request, context, who, code)


async def show_page(
    request: Request, context: Context, who: Principal, code: str, form: LimitsForm | None = None, status: int = 200,
    made: dict[str, Any] | None = None,
) -> Response:  # fmt: skip
    """The page, with the form as it was sent where something was wrong with it.

    `made`: a controller's key that was just made, the only time its text is seen.
    """

    def gather() -> dict[str, Any]:
        row = participants.find(context, code)
        models, shown = context.versions.of(code), render.rows_shown(request)
        tests = context.runner.documents(code, models, shown and shown + 1)
        return {
            "participant": row,
            "notes": context.notes.participant_notes(code),
            "calibrated": starting.calibrated(context, row),
            "step": next_view.step(context, row, who),
            "form": form or limits_form.fresh(row.profile, context.rig.status),
            "meanwhile": participants.meanwhile(context, code),
            "fields": limits_form.fields(context.rig.status),
            "tests": tests[:shown],
            "models": models[:shown],
            "more": shown is not None and max(len(models), len(tests)) > shown,
            "keys": controllers.keys_of(context.auth, code),
            "made": made,
            "trials": trials_of(context, who, code),
            "sensor": limits_form.has_sensor(context.rig.status),
        }

    ask_password = not await context.people.is_confirmed(who.session_hash)
    return page(request, "participant.html", status, ask_password=ask_password, **await asyncio.to_thread(gather))


def trials_of(context: Context, who: Principal, code: str) -> Markup | None:
    """The card of the trials; empty before the first one, None where no model may be tracked."""
    found = trials_card(context, code)
    if found is None:
        return None
    values = {"code": code, "ready": render.rig_now(context, who)["ready"], "signed": signed(who)}
    return Markup(environment.get_template("trials.html").render(trials=found, **values))


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
    status, profile = context.rig.status, row.profile
    sent = await request.form()
    form = limits_form.read(sent, profile, status)
    if form.errors:
        return await show_page(request, context, who, code, form, 422)
    wanted = asked_test(sent, code) if start else None

    async def on() -> str:
        if wanted is None:
            return f"/participants/{code}"
        return await starting.ask(context, who, wanted)

    if not form.asked:
        return RedirectResponse(await on(), 303)
    if not profile:  # nobody has set any yet: they come together
        participants.check_asked(context, profile, form.asked)
    new, voids = profiles.changed(profile, form.asked)

    async def save() -> str:
        row = await participants.change_profile(context, code, form.asked, who.name, bool(voids))
        locking.form_tags.set((str(row.version),))  # what is asked next rests on what was just decided
        return await on()

    doubts = [*profiles.jumps(profile, new), *_lost(context, voids)]
    question = _question(row.code, profile, new, doubts, save)
    return RedirectResponse(await context.questions.ask_if_doubtful(question, who), 303)


def _question(code: str, was: dict[str, Any], new: dict[str, Any], doubts: list[str], save: Any) -> Question:
    lines, values = [], []
    for name, limit in profiles.LIMITS.items():
        value, before = f"{new[name]:g} {limit.unit}", f"{was.get(name, new[name]):g} {limit.unit}"
        lines.append(Row(limit.words.capitalize(), value, before if before != value else ""))
        values.append(value)
    if (range_rad := profiles.range_of(new)) is not None:
        now, was_rad = profiles.range_words(range_rad), profiles.range_of(was)
        before = profiles.range_words(was_rad) if was_rad else "–"
        lines.append(Row("Joint angles", now, before if before != now else ""))
    return Question(
        participant=code,
        title=f"Set these limits for {code}?",
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

    Raises ApiError: 422 what was typed is no target, or no label.
    """
    asked: dict[str, Any] = {name: str(sent.get(name) or "").strip() or None for name in LABEL_TITLES}
    if sent.get("plan") == "adaptive":
        percent = typed.wanted(str(sent.get("target") or ""), no_target)
        if not (LEAST_PERCENT <= percent <= MOST_PERCENT):
            within = f"{percent:g} % is not from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %"
            raise typed.unusable(no_target(within))
        target = TargetIn(curve_percent=percent, step_percent=percent)
        asked |= {"kind": "adaptive", "target": target, "anyway": True}
    return typed.checked(TestIn, participant=code, **asked)


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
    context: Ctx, who: Tester, code: str, file: Annotated[UploadFile, File()], of: Text = ""
) -> Response:  # fmt: skip
    """A recording of another tool, CSV or HDF5; leads to the model made from it."""
    await asyncio.to_thread(participants.find, context, code)
    data = await file.read()
    if not data:
        raise ApiError(422, "empty", "No file came", "Go back and choose a CSV file or a sealed recording (HDF5).")
    _row, model, _warnings = await recordings.take_in(context, code, data, who, of=of)
    return RedirectResponse(f"/models/{model.id}", 303)


@router.post("/keys")
async def make_key(
    request: Request, context: Ctx, who: Approver, code: str, name: Text = "", current_ma: Text = "",
    max_pulse_width_us: Text = "", max_duration_s: Text = "", trials: Text = "",
) -> Response:  # fmt: skip
    """A key that ends with its day; its text is shown on the answering page only."""
    asked = {"current_ma": current_ma, "max_pulse_width_us": max_pulse_width_us, "max_duration_s": max_duration_s}
    numbers = {field: typed.wanted(text, lambda why, field=field: f"{field}: {why}.") for field, text in asked.items()}
    body = typed.checked(controllers.KeyFor, name=name.strip(), trials=typed.whole(trials), **numbers)
    text, made, _version = await asyncio.to_thread(keys.make, context, who, code, body)
    return await show_page(request, context, who, code, made={"text": text, "name": made.name})


@router.post("/keys/{key_id}/revoke")
async def revoke_key(context: Ctx, who: Tester, code: str, key_id: str) -> Response:
    """It opens nothing any more."""
    if not await asyncio.to_thread(controllers.revoke_key, context.auth, code, key_id, who.name):
        raise NotFoundError("key", key_id, "The participant's page lists them.")
    return RedirectResponse(f"/participants/{code}#keys", 303)


environment.globals["note_kinds"] = {
    "spasm": "Spasm", "posture": "Posture", "electrodes": "Electrodes", "side": "Side",
    "medication": "Medication", "other": "Other",
}  # fmt: skip
environment.globals["muscles"] = ("biceps brachii", "triceps brachii")
"""Offered where a muscle is typed; any other may be."""


@router.post("/notes")
async def write_note(
    context: Ctx, who: Tester, code: str, kind: Text = "", text: Text = "",
    test_id: Text = "", at: Text = "", now: Text = "",
    back: Text = "",
) -> Response:  # fmt: skip
    """A note; `now` where the test stands, else at the time that was typed, else on the whole of it."""
    if not kind:
        detail = "Choose what the note is about, then write it down. Nothing was written."
        raise ApiError(422, "invalid-input", "The note has no kind", detail)
    at_s = None
    if at.strip() and not now:
        try:
            at_s = typed.number(at)
        except ValueError as error:
            raise ApiError(422, "invalid-input", "This time cannot be used", str(error)) from None
    fields = {"kind": kind, "text": text, "test_id": test_id or None, "at_s": at_s, "now": bool(now and test_id)}
    await notes.add(context, code, typed.checked(NoteIn, **fields), who.name)
    return RedirectResponse(local(back or f"/participants/{code}") + "#notes", 303)


@router.post("/notes/{note_id}/strike")
async def strike_note(context: Ctx, who: Tester, code: str, note_id: str, back: Text = "") -> Response:
    """Mark a note as wrong."""
    await asyncio.to_thread(context.notes.strike, code, note_id, who.name)
    return RedirectResponse(local(back or f"/participants/{code}") + "#notes", 303)


@router.post("/archive")
async def put_away(context: Ctx, who: Tester, code: str) -> Response:
    """Into the archive."""
    await participants.put_archived(context, code, True, who.name)
    return RedirectResponse("/", 303)


@router.post("/unarchive")
async def take_out(context: Ctx, who: Tester, code: str) -> Response:
    """Out of the archive."""
    await participants.put_archived(context, code, False, who.name)
    return RedirectResponse(f"/participants/{code}", 303)


@router.post("/muscle")
async def set_muscle(
    context: Ctx, who: Tester, code: str, side: Text = "",
    name: Annotated[str, Form(alias="muscle")] = "", placement: Text = "",
) -> Response:  # fmt: skip
    """Say the site; asked about where calibration, approved model or keys would be lost."""
    body = typed.checked(MuscleIn, side=side or None, muscle=name.strip() or None, placement=placement.strip() or None)
    row = await asyncio.to_thread(participants.find, context, code)

    async def save() -> str:
        await participants.change_site(context, code, body, who.name, True)
        return f"/participants/{code}"

    before, after = site_words(site_of(row)), site_words(participants.site_in(body))
    warnings = []
    if participants.loses_calibration(row, body):
        warnings += [f"The calibration is lost with it: its thresholds were found at {before}."]
    if before != after and await asyncio.to_thread(context.versions.approved, code) is not None:
        warnings += [f"The approved model and its keys are of {before}. Here there is none."]
    question = Question(
        participant=code,
        title=f"Change side and muscle of {code}?",
        button=f"Yes, it is {after}",
        action=save,
        rows=[Row("Side and muscle", after, before)],
        warnings=warnings,
    )
    return RedirectResponse(await context.questions.ask_if_doubtful(question, who), 303)


@router.get("/trials")
async def trials(context: Ctx, who: Tester, code: str) -> Response:
    """The card by itself, for the script that renews it; empty where there is nothing to tell."""

    def gather() -> str:
        participants.find(context, code)
        return trials_of(context, who, code) or ""

    return HTMLResponse(await asyncio.to_thread(gather))


def trials_card(context: Context, code: str) -> dict[str, Any] | None:
    """What the card shows; None where no model may be tracked today."""
    approval = context.tracked.allowing(code)
    try:
        told = context.tracked.document(code) if approval is not None else None
    except ApiError:  # the model is damaged: its own page says so
        return None
    if approval is None or told is None:
        return None
    model = context.versions.get(approval.model_id)
    recording: Recording = context.store.get(Recording, model.recording_id)
    bounds = Limits(**(approval.tracking or {})).bounds(told["threshold_us"])
    return {
        **told,
        "panels": trend_charts.trial_panels(told["trials"], bounds) if told["trials"] else [],
        "sentences": sentences(told["trials"], recording.created_utc),
        "age": served_age(context, told),
        "rows": [trial_row(trial) for trial in reversed(told["trials"])],
    }


def served_age(context: Context, told: dict[str, Any]) -> str:
    """Since when that is known which the controller gets."""
    minutes = int(max(0.0, context.clock.unix_s() - unix_of(told["served_utc"])) // 60)
    ago = f"{minutes} minute{'' if minutes == 1 else 's'} ago" if minutes else "just now"
    if not told["served_trial"]:
        return "The controller gets the approved model."
    time = clock(told["served_utc"])
    return f"The controller gets the model as of trial {told['served_trial']}, {time} ({ago})."  # fmt: skip


def trial_row(trial: dict[str, Any]) -> dict[str, Any]:
    """A trial in the table."""
    cells = [trend_charts.trial_words(trial, name) for name in trend_charts.TRIAL_FIGURES]
    return {**trial, "cells": cells, "words": OUTCOMES[trial["outcome"]]}
