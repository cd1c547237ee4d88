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
from stimrig.api.people.auth import Scope
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.figures import Width, answer
from stimrig.api.web.pages.model_view import looked_at, measurement
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import story_html

router = APIRouter(include_in_schema=False)


@router.get("/models/{model_id}/story")
async def show_story(request: Request, context: Ctx, who: ModelReader, row: Version, diagnose: int = -1) -> Response:
    """How this model was improved; a diagnosis of it is begun where there is none."""
    looked = await looked_at(context, row, who.name, diagnose)
    shown: dict[str, Any] = {"story": {"title": "", "noise_sd_nm": None}, "problem": None}
    try:
        told = await _told(context, row)
        shown |= {"story": told["told"], "figures": story_figures(**told, at=f"/models/{row.id}/story/figures/{{}}")}
    except ApiError as error:
        shown["problem"] = error
    job = looked["job"]
    return page(
        request,
        "story_page.html",
        model=await asyncio.to_thread(context.versions.document, row),
        may_test=who.may(Scope.RUN_TEST),
        job=job.document() if job and job.state in ("running", "completed") else None,
        **shown,
    )


@router.get("/models/{model_id}/story.html")
async def story_file(context: Ctx, _who: ModelReader, row: Version) -> Response:
    """The same as one file that needs no network."""
    text = story_html(**await _told(context, row), name=f"{row.participant}, {row.created_utc}")
    headers = {"Content-Disposition": "attachment"}
    return Response(text, media_type="text/html; charset=utf-8", headers=headers)


@router.get("/models/{model_id}/story/figures/{name}")
async def story_figure(
    request: Request, context: Ctx, _who: ModelReader, row: Version, name: str, width: Width = 720
) -> Response:
    """One figure: for the page, or as SVG or PDF for a paper."""
    figures = story_figures(**await _told(context, row))
    return await asyncio.to_thread(answer, request, figures, name, width)


async def _told(context: Context, row: Model) -> dict[str, Any]:
    """The story of a version, with what its figures are drawn from. Raises ApiError where it cannot be compared."""
    path = await asyncio.to_thread(context.versions.ancestry, row)
    before = await _measured(context, path[0])
    after = before if len(path) == 1 else await _measured(context, row)
    rows, diagnoses = await asyncio.to_thread(_known, context, path)
    told = story(rows, before["comparison"], after["comparison"], diagnoses[0], diagnoses[-1])
    return {"told": told, "before": before, "after": after}


async def _measured(context: Context, row: Model) -> dict[str, Any]:
    found = await measurement(context, row)
    if found["problem"] is not None:
        raise found["problem"]
    return found


def _known(context: Context, path: list[Model]) -> tuple[list[dict[str, Any]], list[dict[str, Any] | None]]:
    documents = [context.versions.document(version) for version in path]
    documents[-1]["repetition"] = stored_model.repetition(stored_model.read(path[-1]))
    rows = explanation.versions(documents, path[-1].id)
    last = context.analyses.known_diagnosis(path[-1])
    return rows, [last if len(path) == 1 else context.analyses.known_diagnosis(path[0]), last]
