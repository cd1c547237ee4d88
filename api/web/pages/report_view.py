"""A model's report as one file, to print and to sign; and the story of its improvement."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response

from stimrig.api import local_time
from stimrig.api.charts.figure import Figures
from stimrig.api.clock import local_day
from stimrig.api.effect_words import effects_words
from stimrig.api.models import explanation, stored_model
from stimrig.api.models.places import site_of, site_of_recording
from stimrig.api.models.story import story
from stimrig.api.services.notes import of_participant
from stimrig.api.store.tables import Model, Note, Participant, Recording, Test
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages import report_file
from stimrig.api.web.pages.model_view import measurement, parts

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}")


@router.get("/report")
async def report(request: Request, context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Write a model's report, as it stands now."""
    content = await parts(context, row)

    def write() -> str:
        model, recording = content["model"], context.store.get(Recording, row.recording_id)
        session, held = session_of(context, recording), effects_words(model["effects"], model["without_evidence"])
        made = local_time.when(model["created_utc"])
        return report_file.write(
            **content
            | {
                "title": f"Muscle model of {row.participant}",
                "lead": f"{made}, with {held}" if held else made,
                "figures": Figures(content["figures"]),
                "recording": recording,
                "digest": (content["document"].get("data") or {}).get("sha256") or "",
                "session": session,
                "summary": {**((session["test"] and session["test"].summary) or {}), "warnings": content["warnings"]},
                "footer": f"stimrig {request.app.version} · written {local_time.when(context.clock.utc())} · no "
                "medical device. Print it, or save it as PDF, with the browser's own print command.",
            }
        )

    return HTMLResponse(await asyncio.to_thread(write))


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
    return {
        "site": site_of_recording(recording, test if test and "side" in test.plan else None) or site_of(participant),
        "profile": (test.plan.get("profile") or {}) if test else {},
        "test": test,
        "ran_by": (test.ran_by or test.requested_by) if test else None,
        "notes": [*sorted(of_test, key=lambda note: -1.0 if note.at_s is None else note.at_s), *reversed(general)],
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
        return report_file.story_html(narrative, before, after, f"{row.participant}, {row.created_utc}")

    return HTMLResponse(await asyncio.to_thread(write), headers={"Content-Disposition": "attachment"})


async def _measured(context: Context, row: Model) -> dict[str, Any]:
    measured = await measurement(context, row)
    if measured["problem"] is not None:
        raise measured["problem"]
    return measured
