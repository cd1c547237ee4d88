"""Page on which a reference torque is chosen; `widths.js` asks REST for the pulse widths and shows the answer."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request
from fastapi.responses import Response

from stimrig.api.models.inverted import REASONS
from stimrig.api.web.dependencies import Ctx, ModelReader, Version
from stimrig.api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/models/{model_id}/widths")
async def show(request: Request, context: Ctx, _principal: ModelReader, row: Version) -> Response:
    """Show the form."""
    version = await asyncio.to_thread(context.versions.document, row)
    return page(request, "widths.html", model=version, reasons=REASONS)
