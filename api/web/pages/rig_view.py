"""The rig's state, which scripts on every page poll, and the page of a stop's result."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.errors import ApiError
from stimrig.api.web.dependencies import Ctx
from stimrig.api.web.pages import render
from stimrig.api.web.pages.render import identify_viewer, page

router = APIRouter(include_in_schema=False)


@router.get("/rig/now")
async def rig_now(request: Request, context: Ctx) -> Response:
    """Return the state for the bar of every page, also of one whose session has ended."""
    principal, ended, signed_in = None, False, False
    try:
        principal = await context.auth.authenticate(request)
        signed_in = True
    except ApiError as error:  # the state is told all the same
        ended = error.extra.get("ended", False)
    except SQLAlchemyError:
        signed_in = None
    return JSONResponse({**render.rig_now(context, principal), "signed_in": signed_in, "ended": ended})


@router.get("/stopped/{key}")
async def stopped(request: Request, context: Ctx, key: str) -> Response:
    """Show the rig's evidence that stimulation has stopped, or why that is not sure.

    Open to whoever has its address, since a session may have ended by then.
    """
    stop = context.stops.get(key)
    request.state.stop_right = stop.right
    await identify_viewer(request)
    if isinstance(stop.answer, ApiError):
        return page(request, "problem.html", stop.answer.status, problem=stop.answer, back=None)
    return page(request, "stop.html", stop=stop, evidence=stop.answer)
