"""Notes on a session and at times in a test."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Response

from stimrig.api.sessions import notes
from stimrig.api.sessions.requests import NoteIn
from stimrig.api.store.tables import Note
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, Tester
from stimrig.api.web.responses.base import answers
from stimrig.api.web.responses.participants import NoteOut
from stimrig.api.web.routes import participants

router = APIRouter(prefix="/v1/participants/{code}/notes", tags=["notes"], responses=PROBLEM)


async def add(context: Context, code: str, body: NoteIn, by: str) -> Note:
    """Write a note; one that is made now is at the place where the test stands."""
    position = context.runner.hub.position(body.test_id) if body.test_id else None
    now_s = position[0] if position and context.runner.plays(body.test_id) else None
    return await asyncio.to_thread(context.notes.add, code, body, by, now_s)


@router.get("", **answers(list[NoteOut]))
def list_notes(context: Ctx, _who: Tester, code: str, response: Response) -> list[dict[str, Any]]:
    """A participant's notes, newest first, the struck ones among them."""
    response.headers["ETag"] = context.store.etag(context.clock, f"/v1/participants/{code}/notes", notes.about(code))
    participants.find(context, code)
    return [note.as_dict() for note in context.notes.of(code)]


@router.post("", status_code=201, **answers(NoteOut, 201, "written"))
async def write_note(context: Ctx, who: Tester, code: str, body: NoteIn) -> dict[str, Any]:
    """Write a note on the participant's session, on a test (`test_id`), or at a time in it (`at_s`, or `now`)."""
    return (await add(context, code, body, who.name)).as_dict()


@router.post("/{note_id}/strike", **answers(NoteOut))
def strike_note(context: Ctx, who: Tester, code: str, note_id: str) -> dict[str, Any]:
    """Mark a note as wrong: it stays readable, with who struck it."""
    return context.notes.strike(code, note_id, who.name).as_dict()
