"""A page's charts, each by itself: a still for the page, files to keep or print, and what plotly takes."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from stimrig.api.charts.drawing import Figures, svg
from stimrig.api.charts.interactive import TOOLBAR_PX, page_figure
from stimrig.api.errors import NotFoundError
from stimrig.api.web.dependencies import Ctx, ModelReader, Version
from stimrig.api.web.middleware import entity_tags
from stimrig.api.web.pages import model_view, trend_view

router = APIRouter(include_in_schema=False)
KINDS = {
    "html": "text/html; charset=utf-8",
    "json": "application/json",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
    "png": "image/png",
}
Width = Annotated[int, Query(ge=240, le=2400)]


@router.get("/models/{model_id}/figures/{name}")
async def of_model(
    request: Request, context: Ctx, _principal: ModelReader, row: Version, name: str, width: Width = 720
) -> Response:
    """Return one of the charts of a model's page, its kind at the end of its name."""
    figures = (await model_view.parts(context, row))["figures"]
    return await asyncio.to_thread(answer, request, figures, name, width)


@router.get("/compare/figures/{name}")
async def compared(
    request: Request, context: Ctx, _principal: ModelReader, name: str,
    model: Annotated[list[str] | None, Query()] = None, width: Width = 720,
) -> Response:  # fmt: skip
    """Return one of the charts of models side by side."""
    rows = await trend_view.chosen(context, model)
    figures = await trend_view.figures_of(context, rows)
    return await asyncio.to_thread(answer, request, figures, name, width)


def answer(request: Request, figures: Figures, name: str, width: int) -> Response:
    """Return a figure as `name` asks for it: a part of a page, a file to keep, or what plotly takes."""
    stem, _dot, kind = name.rpartition(".")
    if stem not in figures or kind not in KINDS:
        raise NotFoundError("chart", name)
    if kind == "json":
        file_name = f"{request.path_params.get('model_id', 'compare')}-{stem}"
        body = json.dumps(page_figure(figures[stem], file_name)).encode()
    else:
        body = (
            svg(figures[stem], width, right=TOOLBAR_PX).encode() if kind == "html" else figures.file(stem, kind, width)
        )
    return to_keep(request, body, KINDS[kind])


def to_keep(request: Request, body: bytes, kind: str) -> Response:
    """Return an answer that browsers keep, and ask about each time."""
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
    headers = {"Cache-Control": "private, no-cache", "ETag": tag, "Vary": "Accept-Encoding"}
    if tag in entity_tags(request.headers.get("if-none-match", "")):
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):  # nothing that anybody typed is in it beside a secret
        body, headers["Content-Encoding"] = gzip.compress(body, 5, mtime=0), "gzip"
    return Response(body, media_type=kind, headers=headers)
