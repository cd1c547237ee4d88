"""A model's report on one sheet: session, verdict, curves, what is missing, who decided, a place to sign. No script."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts.drawing import svg
from stimrig.api.clock import local_day
from stimrig.api.models import explanation, stored_model
from stimrig.api.models.places import site_of, site_of_recording
from stimrig.api.store.tables import Note, Participant, Recording, Test
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.model_view import draw_own, facts, measurement, versions_of
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)
SIZES = {
    "comparison": (760.0, 312.0), "recruitment": (375.0, 215.0), "step": (375.0, 215.0), "joint_g": (760.0, 215.0),
    "joint_h": (760.0, 215.0),
}  # fmt: skip
MOST_NOTES = 12
"""Notes on one report; the participant's page has all of them."""


@router.get("/models/{model_id}/report")
async def report(request: Request, context: Ctx, _who: ModelReader, row: Version) -> Response:
    """One sheet on a model."""
    document = stored_model.read(row)
    measured = await measurement(context, row)
    found = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    recording: Recording = await asyncio.to_thread(context.store.get, Recording, row.recording_id)
    figures = draw_own(document, measured)
    words = {
        "comparison": "Torque measured and predicted, what is left, and the pulse width, over time",
        "recruitment": "Steady torque over pulse width",
        "step": "Step response over time",
        "joint_g": "Share of the muscle's torque over the angle of the joint",
        "joint_h": "Passive torque over the angle of the joint",
    }
    drawn = {name: svg(figures[name], *SIZES[name], words[name], light=True) for name in words if name in figures}
    return page(
        request,
        "report_sheet.html",
        model=await asyncio.to_thread(context.versions.document, row),
        **await facts(context, row, document),
        drawn=drawn,
        problem=measured["problem"],
        why=explanation.view(found, measured["comparison"]) if found else None,
        versions=await asyncio.to_thread(versions_of, context, row),
        recording=recording,
        session=await asyncio.to_thread(session_of, context, recording),
    )


def session_of(context: Context, recording: Recording) -> dict[str, Any]:
    """The session that a recording belongs to, as it was when its test was begun; `test` None: it was uploaded.

    The site of a record whose site was not kept is that of now.
    """
    participant: Participant = context.store.get(Participant, recording.participant)
    test: Test | None = context.store.get(Test, recording.test_id) if recording.test_id else None
    notes = _notes(context, recording, test)
    kept = site_of_recording(recording, test if test and "side" in test.plan else None)
    return {
        "site": kept or site_of(participant),
        "profile": (test.plan.get("profile") or {}) if test else {},
        "test": test,
        "ran_by": (test.ran_by or test.requested_by) if test else None,
        "notes": notes[:MOST_NOTES],
        "more_notes": max(0, len(notes) - MOST_NOTES),
    }


def _notes(context: Context, recording: Recording, test: Test | None) -> list[Note]:
    """The test's by their time in it, then those on the day as a whole."""
    standing = [note for note in context.notes.participant_notes(recording.participant) if note.struck_utc is None]
    own = [note for note in standing if test is not None and note.test_id == test.id]
    today = local_day(test.requested_utc if test else recording.created_utc)
    general = [note for note in standing if note.test_id is None and local_day(note.at_utc) == today]
    return [*sorted(own, key=lambda note: -1.0 if note.at_s is None else note.at_s), *reversed(general)]
