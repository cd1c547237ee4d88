"""The story of a model as one file: where it failed, what was missing, how the error fell once that was added."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter
from fastapi.responses import Response

from stimrig.api.models import explanation, stored_model
from stimrig.api.models.story import story
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.model_view import measurement
from stimrig.api.web.pages.report_file import story_html

router = APIRouter(include_in_schema=False)


@router.get("/models/{model_id}/story.html")
async def story_file(context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Give the story of a version as a file that needs no network."""
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
