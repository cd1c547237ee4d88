"""A model's report on one sheet without a script, to print and to sign; and the story of its improvement as a file."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts.drawing import svg
from stimrig.api.clock import local_day
from stimrig.api.models import explanation, stored_model
from stimrig.api.models.places import site_of, site_of_recording
from stimrig.api.models.story import story
from stimrig.api.services.notes import of_participant
from stimrig.api.store.tables import Model, Note, Participant, Recording, Test
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.model_view import measurement, parts
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import story_html

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}")
CHARTS = {
    "comparison": (760.0, 312.0, "Torque measured and predicted, what is left, and the pulse width, over time"),
    "recruitment": (375.0, 215.0, "Steady torque over pulse width"),
    "step": (375.0, 215.0, "Step response over time"),
    "joint_g": (760.0, 215.0, "Share of the muscle's torque over the angle of the joint"),
    "joint_h": (760.0, 215.0, "Passive torque over the angle of the joint"),
}
"""Width and height (px) of each chart, and what it shows."""
MOST_NOTES = 12
"""Notes on one report; the participant's page has all of them."""


@router.get("/report")
async def report(request: Request, context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Show one sheet on a model."""
    content = await parts(context, row)

    def write() -> Response:
        figures, recording = content["figures"], context.store.get(Recording, row.recording_id)
        pictures = {name: svg(figures[name], *place, light=True) for name, place in CHARTS.items() if name in figures}
        session = session_of(context, recording)
        return page(request, "report_sheet.html", **content, drawn=pictures, recording=recording, session=session)

    return await asyncio.to_thread(write)


def session_of(context: Context, recording: Recording) -> dict[str, Any]:
    """Return the session of a recording, as it was when its test was begun; `test` None: it was uploaded.

    The site of a record whose site was not kept is that of now. Notes: those of the test by their time in it, then
    those on the day as a whole.
    """
    participant: Participant = context.store.get(Participant, recording.participant)
    test: Test | None = context.store.get(Test, recording.test_id) if recording.test_id else None
    valid = [note for note in of_participant(context.store, recording.participant) if note.struck_utc is None]
    day = local_day(test.requested_utc if test else recording.created_utc)
    general: list[Note] = [note for note in valid if note.test_id is None and local_day(note.at_utc) == day]
    of_test: list[Note] = [note for note in valid if test is not None and note.test_id == test.id]
    notes = [*sorted(of_test, key=lambda note: -1.0 if note.at_s is None else note.at_s), *reversed(general)]
    return {
        "site": site_of_recording(recording, test if test and "side" in test.plan else None) or site_of(participant),
        "profile": (test.plan.get("profile") or {}) if test else {},
        "test": test,
        "ran_by": (test.ran_by or test.requested_by) if test else None,
        "notes": notes[:MOST_NOTES],
        "more_notes": max(0, len(notes) - MOST_NOTES),
    }


@router.get("/story.html")
async def story_file(context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Give the story of a version: where it failed, what was missing, how the error fell once that was added."""
    path = await asyncio.to_thread(context.versions.ancestry, row)
    before = await _measured(context, path[0])
    after = before if len(path) == 1 else await _measured(context, row)

    def write() -> str:
        documents = [context.versions.document(version) for version in path]
        documents[-1]["repetition"] = stored_model.repetition(stored_model.read(row))
        rows = explanation.versions(documents, row.id)
        first, last = (context.analyses.known_diagnosis(version) for version in (path[0], row))
        narrative = story(rows, before["comparison"], after["comparison"], first, last)
        return story_html(narrative, before, after, f"{row.participant}, {row.created_utc}")

    text = await asyncio.to_thread(write)
    return Response(text, media_type="text/html; charset=utf-8", headers={"Content-Disposition": "attachment"})


async def _measured(context: Context, row: Model) -> dict[str, Any]:
    measured = await measurement(context, row)
    if measured["problem"] is not None:
        raise measured["problem"]
    return measured
