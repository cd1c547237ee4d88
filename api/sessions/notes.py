"""Notes on a session, or at a time in a test: written once, struck where they are wrong, never deleted."""

from __future__ import annotations

import math
import secrets
from typing import get_args

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, NotFoundError, require_found
from stimrig.api.sessions.requests import NoteIn, NoteKind
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Note, Participant, Test

KINDS: tuple[NoteKind, ...] = get_args(NoteKind)
MAX_NOTES = 2000
"""Notes of one participant."""


class Notes:
    """The notes of all participants."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self.store, self.clock = store, clock

    def participant_notes(self, participant: str) -> list[Note]:
        """A participant's notes, newest first, the struck ones among them."""
        return self.store.all(Note, Note.participant == participant, order=Note.at_utc.desc())

    def test_notes(self, test_id: str) -> list[Note]:
        """List the notes of one test by time; those on the whole test first."""
        notes = self.store.all(Note, Note.test_id == test_id, order=Note.at_utc)
        return sorted(notes, key=lambda note: -1.0 if note.at_s is None else note.at_s)

    def add(self, participant: str, body: NoteIn, by: str, now_s: float | None = None) -> Note:
        """Write a note.

        Parameters
        ----------
        participant : str
            Code.
        body : NoteIn
            The note.
        by : str
            Who writes it.
        now_s : float, optional
            Where its test stands, if it runs: the time of a note that is made `now`.

        Raises
        ------
        ApiError
            404 no such participant, or no such test of it; 409 the test does not run, or there are too many notes; 422
            the time lies outside of the test.
        """
        with self.store.write() as session:
            self._check(session, participant, body)
            at_s = body.at_s
            if body.now:
                if now_s is None:
                    raise ApiError(409, "not-running", "The test does not run", "Give the time in it: at_s.")
                at_s = round(now_s, 2)
            note = Note(id=f"N{secrets.token_hex(8)}", participant=participant, test_id=body.test_id, at_s=at_s)
            note.kind, note.text, note.by, note.at_utc = body.kind, body.text, by, self.clock.utc()
            session.add(note)
            detail = {"note": note.id, "kind": note.kind, "text": note.text, "test": note.test_id, "at_s": note.at_s}
            audit.write(session, note.at_utc, by, "note", participant, **detail)
        return note

    def _check(self, session: Session, participant: str, body: NoteIn) -> None:
        require_found(session.get(Participant, participant), "participant", participant)
        count = session.scalar(select(func.count()).where(Note.participant == participant)) or 0
        if count >= MAX_NOTES:
            detail = f"{participant} has {count} notes, as many as are kept. Write the next one elsewhere."
            raise ApiError(409, "too-many-notes", "There are too many notes", detail)
        if body.test_id is None:
            return
        test = session.get(Test, body.test_id)
        if test is None or test.participant != participant:
            raise NotFoundError("test", body.test_id, f"GET /v1/tests?participant={participant} lists them.")
        last_s = duration_s(test)
        if body.at_s is not None and not (body.at_s <= last_s):
            detail = f"The test lasts {last_s:.1f} s; {body.at_s:g} s is after its end."
            raise ApiError(422, "invalid-input", "This time is not in the test", detail)

    def strike(self, participant: str, note_id: str, by: str) -> Note:
        """Mark a note as wrong; it stays readable, with who struck it. Striking it again changes nothing.

        Raises ApiError: 404 the participant has no such note.
        """
        with self.store.write() as session:
            note = session.get(Note, note_id)
            if note is None or note.participant != participant:
                raise NotFoundError("note", note_id, f"GET /v1/participants/{participant}/notes lists them.")
            if note.struck_utc is None:
                now = self.clock.utc()
                note.struck_utc, note.struck_by = now, by
                audit.write(session, now, by, "strike note", participant, note=note.id)
        return note


def duration_s(test: Test) -> float:
    """Return a test's duration, s; while it runs, the planned one."""
    played = test.summary.get("duration_s")
    planned = (test.plan.get("preview") or {}).get("duration_s")
    duration = float(played if played is not None else planned or 0.0)
    return duration if math.isfinite(duration) else 0.0
