"""What scripts on every page ask for: the rig's state, and the notice about it; what stop did, and re-arming."""

from __future__ import annotations

from collections.abc import Collection

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.errors import ApiError
from stimrig.api.people.auth import LOCKED
from stimrig.api.services.rig import rearm as rearm_rig
from stimrig.api.web.dependencies import Anyone, Ctx, Rearmer
from stimrig.api.web.guards import local, same_origin
from stimrig.api.web.pages import render
from stimrig.api.web.pages.render import CHOICES, COLOURS, fragment, look, page
from stimrig.api.web.pages.typed import Text

router = APIRouter(include_in_schema=False)


@router.get("/rig/now")
async def rig_now(request: Request, context: Ctx) -> Response:
    """The state for the bar of every page, also of one whose session has ended."""
    principal, locked, known = None, False, True
    try:
        principal = await context.auth.ask(request)
    except ApiError as error:  # the state is told all the same
        locked = error.code == LOCKED[0]
    except SQLAlchemyError:
        known = False
    signed_in = principal is not None if known else None
    return JSONResponse({**render.rig_now(context, principal), "signed_in": signed_in, "locked": locked})


@router.post("/rig/acted")
async def acted(_who: Anyone) -> Response:
    """A person has typed or moved the pointer on a page: its session is not idle."""
    return Response(status_code=204)


@router.get("/rig/notice")
async def rig_notice(context: Ctx, who: Anyone, back: str = "/") -> Response:
    """The notice alone, for a page on which it has changed."""
    return HTMLResponse(fragment(context, "notice.html", who, local(back)))


@router.get("/stopped/{key}")
async def stopped(request: Request, context: Ctx, key: str) -> Response:
    """The rig's evidence that stimulation has stopped, or why that is not sure.

    Open to whoever has its address, since a session may have ended by then.
    """
    told = context.stops.get(key)
    request.state.stop_right = told.right
    await look(request)
    if isinstance(told.answer, ApiError):
        return page(request, "problem.html", told.answer.status, problem=told.answer, back=None)
    return page(request, "stop.html", told=told, evidence=told.answer)


@router.post("/rearm")
async def rearm(context: Ctx, who: Rearmer, back: Text = "/") -> Response:
    """A person has looked, and lets the rig work again."""
    await rearm_rig(context, who.name)
    return RedirectResponse(local(back), 303)


KEPT_S = 365 * 24 * 3600


@router.post("/colours")
async def choose_colours(request: Request, colours: Text = "", back: Text = "/") -> Response:
    """Show the pages in these colours from now on."""
    answer = _back(request, colours, CHOICES, back, ("no-such-colours", "There are no such colours"))
    answer.set_cookie(COLOURS, colours, KEPT_S, samesite="lax")
    return answer


def _back(request: Request, chosen: str, known: Collection[str], back: str, none_such: tuple[str, str]) -> Response:
    """To the page that it was chosen on. Raises ApiError (422) where there is no such thing."""
    same_origin(request)
    if chosen not in known:
        raise ApiError(422, *none_such, f"Take one of {', '.join(known)}.")
    return RedirectResponse(local(back), 303)
