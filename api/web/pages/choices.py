"""What a person chooses at the foot of every page, in this browser: language, light or dark. It needs no sign-in."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.errors import ApiError
from stimrig.api.language import CODES
from stimrig.api.web.dependencies import Ctx
from stimrig.api.web.guards import local, same_origin
from stimrig.api.web.middleware import LANGUAGE_COOKIE

router = APIRouter(include_in_schema=False)
COLOURS = "stimrig_colours"
"""The choice; it says nothing about who chose. `colours.js` writes it, too: then no page has to be loaded again."""
KEPT_S = 365 * 24 * 3600
MEDIA = {"light": "not all", "dark": "screen", "system": "screen and (prefers-color-scheme: dark)"}
"""For which media `dark.css` holds. Never for print."""
Back = Annotated[str, Form()]


def colours(request: Request) -> str:
    """The colours that were chosen, else as the system is set."""
    kept = request.cookies.get(COLOURS, "")
    return kept if kept in MEDIA else "system"


@router.post("/language")
async def choose_language(
    request: Request, context: Ctx, language: Annotated[str, Form()] = "", back: Back = "/"
) -> Response:
    """Write the pages in this language from now on."""
    answer = _back(request, language, CODES, back, ("no-such-language", "There is no such language"))
    secure = context.settings.secure_cookies
    answer.set_cookie(LANGUAGE_COOKIE, language, KEPT_S, httponly=True, samesite="lax", secure=secure)
    return answer


@router.post("/colours")
async def choose_colours(request: Request, colours: Annotated[str, Form()] = "", back: Back = "/") -> Response:
    """Show the pages in these colours from now on."""
    answer = _back(request, colours, MEDIA, back, ("no-such-colours", "There are no such colours"))
    answer.set_cookie(COLOURS, colours, KEPT_S, samesite="lax")
    return answer


def _back(request: Request, chosen: str, known: Collection[str], back: str, none_such: tuple[str, str]) -> Response:
    """To the page that it was chosen on. Raises ApiError (422) where there is no such thing."""
    same_origin(request)
    if chosen not in known:
        raise ApiError(422, *none_such, f"Take one of {', '.join(known)}.")
    return RedirectResponse(local(back), 303)
