"""What a report says of the session that a model comes from: whose arm, how strong, which thresholds, who ran it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from api.clock import local_day
from api.models.places import Site, site_of, site_of_recording
from api.store.tables import Note, Participant, Recording, Test
from api.web.dependencies import Context

MOST_NOTES = 12
"""Notes on one report; the participant's page has all of them."""


@dataclass(frozen=True)
class SessionFacts:
    """The session of a model, as it was when its test was begun.

    Parameters
    ----------
    site : list of str or None
        As it was then; of a record whose site was not kept, as it is now.
    profile : dict
        The limits and thresholds of that test; empty for a record that was uploaded.
    test : Test or None
        None: the record was uploaded.
    notes : list of Note
        Those of the test, and of the participant on its day, that nobody struck.
    more_notes : int
        So many do not fit on the report.
    """

    site: Site
    profile: dict[str, Any]
    test: Test | None
    notes: list[Note]
    more_notes: int

    @property
    def ran_by(self) -> str | None:
        """Who ran the test at the rig."""
        return (self.test.ran_by or self.test.requested_by) if self.test else None


def of(context: Context, recording: Recording) -> SessionFacts:
    """The session that a recording belongs to."""
    participant: Participant = context.store.get(Participant, recording.participant)
    test: Test | None = context.store.get(Test, recording.test_id) if recording.test_id else None
    notes = _notes(context, recording, test)
    kept = site_of_recording(recording, test if test and "side" in test.plan else None)
    return SessionFacts(
        kept or site_of(participant), (test.plan.get("profile") or {}) if test else {}, test,
        notes[:MOST_NOTES], max(0, len(notes) - MOST_NOTES),
    )  # fmt: skip


def _notes(context: Context, recording: Recording, test: Test | None) -> list[Note]:
    """The test's by their time in it, then those on the day as a whole."""
    standing = [note for note in context.notes.of(recording.participant) if note.struck_utc is None]
    own = [note for note in standing if test is not None and note.test_id == test.id]
    today = local_day(test.requested_utc if test else recording.created_utc)
    general = [note for note in standing if note.test_id is None and local_day(note.at_utc) == today]
    return [*sorted(own, key=lambda note: -1.0 if note.at_s is None else note.at_s), *reversed(general)]
