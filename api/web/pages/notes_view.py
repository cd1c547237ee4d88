"""Notes, the archive and side and muscle on pages: plain forms that do what the REST routes do, and lead back."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Form
from fastapi.responses import RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.language import _, lazy
from stimrig.api.models.places import site_of
from stimrig.api.sessions.questions import Question, Row
from stimrig.api.sessions.requests import MuscleIn, NoteIn, RanByIn
from stimrig.api.store import seen
from stimrig.api.web.dependencies import Ctx, Tester
from stimrig.api.web.guards import local
from stimrig.api.web.pages import typed
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.starting import site_words
from stimrig.api.web.routes import muscle, notes, participants, tests

router = APIRouter(include_in_schema=False)
ONE = "/participants/{code}"

KINDS: dict[str, Any] = {
    "spasm": lazy("Spasm"),
    "posture": lazy("Posture"),
    "electrodes": lazy("Electrodes"),
    "side": lazy("Side"),
    "medication": lazy("Medication"),
    "other": lazy("Other"),
}
environment.globals["note_kinds"] = KINDS
environment.globals["muscles"] = ("biceps brachii", "triceps brachii")
"""Offered where a muscle is typed; any other may be."""


@router.post(ONE + "/notes")
async def write(
    context: Ctx, who: Tester, code: str, kind: Annotated[str, Form()] = "", text: Annotated[str, Form()] = "",
    test_id: Annotated[str, Form()] = "", at: Annotated[str, Form()] = "", now: Annotated[str, Form()] = "",
    back: Annotated[str, Form()] = "",
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
            raise ApiError(422, "invalid-input", _("This time cannot be used"), str(error)) from None
    fields = {"kind": kind, "text": text, "test_id": test_id or None, "at_s": at_s, "now": bool(now and test_id)}
    await notes.add(context, code, typed.checked(NoteIn, **fields), who.name)
    return RedirectResponse(local(back or f"/participants/{code}") + "#notes", 303)


@router.post(ONE + "/notes/{note_id}/strike")
async def strike(context: Ctx, who: Tester, code: str, note_id: str, back: Annotated[str, Form()] = "") -> Response:
    """Mark a note as wrong."""
    await asyncio.to_thread(context.notes.strike, code, note_id, who.name)
    return RedirectResponse(local(back or f"/participants/{code}") + "#notes", 303)


@router.post(ONE + "/archive")
async def put_away(context: Ctx, who: Tester, code: str) -> Response:
    """Into the archive."""
    await muscle.put(context, code, True, who.name)
    return RedirectResponse("/", 303)


@router.post(ONE + "/unarchive")
async def take_out(context: Ctx, who: Tester, code: str) -> Response:
    """Out of the archive."""
    await muscle.put(context, code, False, who.name)
    return RedirectResponse(f"/participants/{code}", 303)


@router.post(ONE + "/muscle")
async def set_muscle(
    context: Ctx, who: Tester, code: str, side: Annotated[str, Form()] = "",
    name: Annotated[str, Form(alias="muscle")] = "", placement: Annotated[str, Form()] = "",
) -> Response:  # fmt: skip
    """Say the site; asked about where calibration, approved model or keys would be lost."""
    body = typed.checked(MuscleIn, side=side or None, muscle=name.strip() or None, placement=placement.strip() or None)
    row = await asyncio.to_thread(participants.find, context, code)

    async def save() -> str:
        await muscle.change(context, code, body, who.name, voids=True)
        return f"/participants/{code}"

    await asyncio.to_thread(context.store.refuse_changed, seen.participant(code))
    before, after = site_words(site_of(row)), site_words(muscle.site_in(body))
    warnings = []
    if muscle.loses(row, body):
        warnings += [_("The calibration is lost with it: its thresholds were found at %(muscle)s.", muscle=before)]
    if before != after and await asyncio.to_thread(context.versions.approved, code) is not None:
        warnings += [_("The approved model and its keys are of %(muscle)s. Here there is none.", muscle=before)]
    if not warnings:
        return RedirectResponse(await save(), 303)
    question = Question(
        participant=code,
        title=_("Change side and muscle of %(code)s?", code=code),
        button=_("Yes, it is %(muscle)s", muscle=after),
        action=save,
        rows=[Row(_("Side and muscle"), after, before)],
        warnings=warnings,
    )
    return RedirectResponse(context.questions.ask(question, who), 303)


@router.post("/tests/{test_id}/ran-by")
async def set_ran_by(context: Ctx, who: Tester, test_id: str, ran_by: Annotated[str, Form()] = "") -> Response:
    """Say who ran a test at the rig."""
    body = typed.checked(RanByIn, ran_by=ran_by.strip() or None)
    await asyncio.to_thread(tests.change_ran_by, context, test_id, body, who.name)
    return RedirectResponse(f"/tests/{test_id}#notes", 303)
