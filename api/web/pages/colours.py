"""Light or dark: what a person chose on a page, else as the system is set; it needs no sign-in."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.web.browser_session import local, same_origin

router = APIRouter(include_in_schema=False)
COOKIE = "stimrig_colours"
"""The choice; it says nothing about who chose. `colours.js` writes it, too: then no page has to be loaded again."""
KEPT_S = 365 * 24 * 3600
MEDIA = {"light": "not all", "dark": "screen", "system": "screen and (prefers-color-scheme: dark)"}
"""For which media `dark.css` holds. Never for print."""


def chosen(request: Request) -> str:
    """The choice."""
    kept = request.cookies.get(COOKIE, "")
    return kept if kept in MEDIA else "system"


@router.post("/colours")
async def choose(
    request: Request, colours: Annotated[str, Form()] = "", back: Annotated[str, Form()] = "/"
) -> Response:
    """Show the pages in these colours from now on, in this browser."""
    same_origin(request)
    if colours not in MEDIA:
        raise ApiError(422, "no-such-colours", "There are no such colours", f"Take one of {', '.join(MEDIA)}.")
    answer = RedirectResponse(local(back), 303)
    answer.set_cookie(COOKIE, colours, max_age=KEPT_S, samesite="lax")
    return answer
