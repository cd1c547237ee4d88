"""What a person has to know of."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from api.centre import warnings
from api.centre.context import Ctx
from api.web.dependencies import Administrator, ModelReader
from api.web.pages.render import page

router = APIRouter(include_in_schema=False)


@router.get("/warnings")
async def show(request: Request, context: Ctx, _who: ModelReader) -> Response:
    """Those that wait, and the last ones that somebody has acknowledged."""
    waiting = await asyncio.to_thread(warnings.listed, context.store)
    await context.count_warnings()
    seen = await asyncio.to_thread(warnings.listed, context.store, True)
    return page(request, "warnings.html", waiting=waiting, seen=seen[:50])


@router.post("/warnings/{warning_id}/acknowledge")
async def acknowledge(context: Ctx, who: Administrator, warning_id: int) -> Response:
    """A person has seen it."""
    await asyncio.to_thread(warnings.acknowledge, context.store, context.clock, warning_id, who.name)
    return RedirectResponse("/warnings", 303)
