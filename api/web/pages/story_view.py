"""The story of a model: compare, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.charts.story_charts import story_figures
from stimrig.api.errors import ApiError
from stimrig.api.models import explanation, stored_model
from stimrig.api.models.story import story
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.figures import Width, answer
from stimrig.api.web.pages.model_view import measurement
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import story_html

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}/story")


@router.get("")
async def show_story(request: Request, context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Show how a model was improved."""
    parts: dict[str, Any] = {"story": {"title": ""}, "problem": None}
    try:
        known = await _known(context, row)
        parts |= {"story": known["story"], "figures": story_figures(**known, at=f"/models/{row.id}/story/figures/{{}}")}
    except ApiError as error:
        parts["problem"] = error
    version = await asyncio.to_thread(context.versions.document, row)
    return await asyncio.to_thread(page, request, "story_page.html", model=version, **parts)


@router.get(".html")
async def story_file(context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Give the same as one file that needs no network."""
    name = f"{row.participant}, {row.created_utc}"
    text = await asyncio.to_thread(lambda known: story_html(**known, name=name), await _known(context, row))
    return Response(text, media_type="text/html; charset=utf-8", headers={"Content-Disposition": "attachment"})


@router.get("/figures/{name}")
async def story_figure(
    request: Request, context: Ctx, _principal: ModelReader, row: Version, name: str, width: Width = 720
) -> Response:
    """Give one figure, for the page, or as SVG or PDF for a paper."""
    figures = story_figures(**await _known(context, row))
    return await asyncio.to_thread(answer, request, figures, name, width)


async def _known(context: Context, row: Model) -> dict[str, Any]:
    """Return the story of a version and what its figures are drawn from. Raises ApiError where nothing is compared."""
    path = await asyncio.to_thread(context.versions.ancestry, row)
    before = await _measured(context, path[0])
    after = before if len(path) == 1 else await _measured(context, row)

    def read_story() -> dict[str, Any]:
        documents = [context.versions.document(version) for version in path]
        documents[-1]["repetition"] = stored_model.repetition(stored_model.read(row))
        rows = explanation.versions(documents, row.id)
        first, last = (context.analyses.known_diagnosis(version) for version in (path[0], row))
        return story(rows, before["comparison"], after["comparison"], first, last)

    return {"story": await asyncio.to_thread(read_story), "before": before, "after": after}


async def _measured(context: Context, row: Model) -> dict[str, Any]:
    measured = await measurement(context, row)
    if measured["problem"] is not None:
        raise measured["problem"]
    return measured
