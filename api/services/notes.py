"""Notes on a session, or at a time in a test: written once, struck where they are wrong, never deleted."""

from __future__ import annotations

import asyncio
import secrets

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from stimrig.api.errors import ApiError, NotFoundError, require_found
from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import NoteIn
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Note, Participant, Test

MAX_NOTES = 2000
"""Notes of one participant."""


def of_participant(store: Store, code: str) -> list[Note]:
    """List a participant's notes, newest first, the struck ones among them."""
    return store.all(Note, Note.participant == code, order=Note.at_utc.desc())


def of_test(store: Store, test_id: str) -> list[Note]:
    """List the notes of a test by time; those on the whole test first."""
    notes = store.all(Note, Note.test_id == test_id, order=Note.at_utc)
    return sorted(notes, key=lambda note: -1.0 if note.at_s is None else note.at_s)


async def add(context: Context, code: str, body: NoteIn, by: str) -> Note:
    """Write a note; one that is made `now` stands at the time at which its test is.

    Raises ApiError: 404 no such participant, or no such test of it; 409 the test does not run, or there are too many
    notes; 422 the time lies outside of the test.
    """
    position = context.runner.hub.position(body.test_id) if context.runner.plays(body.test_id) else None
    return await asyncio.to_thread(_add, context, code, body, by, position and round(position[0], 2))


def _add(context: Context, code: str, body: NoteIn, by: str, now_s: float | None) -> Note:
    with context.store.write() as session:
        _check(session, code, body)
        if body.now and now_s is None:
            raise ApiError(409, "not-running", "The test does not run", "Give the time in it: at_s.")
        note = Note(
            id=f"N{secrets.token_hex(8)}", participant=code, test_id=body.test_id, kind=body.kind, text=body.text,
            at_s=now_s if body.now else body.at_s, by=by, at_utc=context.clock.utc(),
        )  # fmt: skip
        session.add(note)
        detail = {"note": note.id, "kind": note.kind, "text": note.text, "test": note.test_id, "at_s": note.at_s}
        audit.write(session, note.at_utc, by, "note", code, **detail)
    return note


def _check(session: Session, code: str, body: NoteIn) -> None:
    require_found(session.get(Participant, code), "participant", code)
    count = session.scalar(select(func.count()).where(Note.participant == code)) or 0
    if count >= MAX_NOTES:
        detail = f"{code} has {count} notes, as many as are kept. Write the next one elsewhere."
        raise ApiError(409, "too-many-notes", "There are too many notes", detail)
    if body.test_id is None:
        return
    test = session.get(Test, body.test_id)
    if test is None or test.participant != code:
        raise NotFoundError("test", body.test_id, f"GET /v1/tests?participant={code} lists them.")
    last_s = test.summary.get("duration_s", test.plan["preview"]["duration_s"])
    if body.at_s is not None and not (body.at_s <= last_s):
        detail = f"The test lasts {last_s:.1f} s; {body.at_s:g} s is after its end."
        raise ApiError(422, "invalid-input", "This time is not in the test", detail)


def strike(context: Context, code: str, note_id: str, by: str) -> Note:
    """Mark a note as wrong; it stays readable, with who struck it. Striking it again changes nothing.

    Raises ApiError: 404 the participant has no such note.
    """
    with context.store.write() as session:
        note = session.get(Note, note_id)
        if note is None or note.participant != code:
            raise NotFoundError("note", note_id, f"GET /v1/participants/{code}/notes lists them.")
        if note.struck_utc is None:
            now = context.clock.utc()
            note.struck_utc, note.struck_by = now, by
            audit.write(session, now, by, "strike note", code, note=note.id)
    return note
