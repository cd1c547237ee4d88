"""A model's charts, each by itself: a still for its page, a file to keep, and what plotly takes."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from stimrig.api.charts.figure import Figures
from stimrig.api.charts.interactive import for_plotly
from stimrig.api.errors import NotFoundError
from stimrig.api.web.dependencies import Ctx, ModelReader, Version
from stimrig.api.web.middleware import entity_tags
from stimrig.api.web.pages import model_view

router = APIRouter(include_in_schema=False)
KINDS = {"html": "text/html; charset=utf-8", "json": "application/json", "svg": "image/svg+xml"}


@router.get("/models/{model_id}/figures/{name}")
async def figure(
    request: Request, context: Ctx, _principal: ModelReader, row: Version, name: str,
    width: Annotated[int, Query(ge=240, le=2400)] = 720,
) -> Response:  # fmt: skip
    """Return one of the charts of a model's page; browsers keep it, and ask about it each time."""
    figures, (stem, _dot, kind) = (await model_view.parts(context, row))["figures"], name.rpartition(".")
    if stem not in figures or kind not in KINDS:
        raise NotFoundError("chart", name)
    if kind == "json":
        body = json.dumps(for_plotly(figures[stem], f"{row.id}-{stem}")).encode()
    else:
        style: dict[str, Any] = {"right": Figures.TOOLS_PX} if kind == "html" else {"light": True}
        body = (await asyncio.to_thread(figures[stem].svg, width, **style)).encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
    headers = {"Cache-Control": "private, no-cache", "ETag": tag, "Vary": "Accept-Encoding"}
    if tag in entity_tags(request.headers.get("if-none-match", "")):
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):  # nothing that anybody typed is in it beside a secret
        body, headers["Content-Encoding"] = gzip.compress(body, 5, mtime=0), "gzip"
    return Response(body, media_type=KINDS[kind], headers=headers)
