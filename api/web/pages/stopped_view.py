"""What a press of the stop button did; open to whoever has its address, since a session may have ended by then."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import Response

from api.errors import ApiError
from api.web.dependencies import Ctx
from api.web.pages.render import look, page

router = APIRouter(include_in_schema=False)


@router.get("/stopped/{key}")
async def stopped(request: Request, context: Ctx, key: str) -> Response:
    """The rig's evidence that stimulation has stopped, or why that is not sure."""
    told = context.stops.get(key)
    request.state.stop_right = told.right
    await look(request)
    if isinstance(told.answer, ApiError):
        return page(request, "problem.html", told.answer.status, problem=told.answer, back=None)
    return page(request, "stop.html", told=told, evidence=told.answer)
