"""A model's report on one sheet, without a script: session, verdict, curves, what is missing, a place to sign."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts.drawing import svg
from stimrig.api.clock import local_day
from stimrig.api.models.places import site_of, site_of_recording
from stimrig.api.services import notes
from stimrig.api.store.tables import Note, Participant, Recording, Test
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.model_view import parts
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)
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


@router.get("/models/{model_id}/report")
async def report(request: Request, context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Show one sheet on a model."""
    shown = await parts(context, row)
    recording: Recording = await asyncio.to_thread(context.store.get, Recording, row.recording_id)
    charts_svg = await asyncio.to_thread(
        lambda: {
            name: svg(shown["figures"][name], width, height, words, light=True)
            for name, (width, height, words) in CHARTS.items()
            if name in shown["figures"]
        }
    )
    session = await asyncio.to_thread(session_of, context, recording)
    return page(request, "report_sheet.html", **shown, drawn=charts_svg, recording=recording, session=session)


def session_of(context: Context, recording: Recording) -> dict[str, Any]:
    """Return the session of a recording, as it was when its test was begun; `test` None: it was uploaded.

    The site of a record whose site was not kept is that of now.
    """
    participant: Participant = context.store.get(Participant, recording.participant)
    test: Test | None = context.store.get(Test, recording.test_id) if recording.test_id else None
    notes = _notes(context, recording, test)
    site = site_of_recording(recording, test if test and "side" in test.plan else None)
    return {
        "site": site or site_of(participant),
        "profile": (test.plan.get("profile") or {}) if test else {},
        "test": test,
        "ran_by": (test.ran_by or test.requested_by) if test else None,
        "notes": notes[:MOST_NOTES],
        "more_notes": max(0, len(notes) - MOST_NOTES),
    }


def _notes(context: Context, recording: Recording, test: Test | None) -> list[Note]:
    """List the test's notes by their time in it, then those on the day as a whole."""
    valid = [note for note in notes.of_participant(context.store, recording.participant) if note.struck_utc is None]
    of_test = [note for note in valid if test is not None and note.test_id == test.id]
    today = local_day(test.requested_utc if test else recording.created_utc)
    general = [note for note in valid if note.test_id is None and local_day(note.at_utc) == today]
    return [*sorted(of_test, key=lambda note: -1.0 if note.at_s is None else note.at_s), *reversed(general)]
