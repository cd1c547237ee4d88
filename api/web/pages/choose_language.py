"""The choice of a language, at the foot of every page; it needs no sign-in."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from api.errors import ApiError
from api.language import CODES
from api.web.browser_session import local, same_origin
from api.web.dependencies import Ctx
from api.web.page_language import COOKIE

router = APIRouter(include_in_schema=False)
KEPT_S = 365 * 24 * 3600


@router.post("/language")
async def choose(
    request: Request, context: Ctx, language: Annotated[str, Form()] = "", back: Annotated[str, Form()] = "/"
) -> Response:
    """Write the pages in this language from now on, in this browser."""
    same_origin(request)
    if language not in CODES:
        raise ApiError(422, "no-such-language", "There is no such language", f"Take one of {', '.join(CODES)}.")
    answer = RedirectResponse(local(back), 303)
    secure = context.settings.secure_cookies
    answer.set_cookie(COOKIE, language, max_age=KEPT_S, httponly=True, samesite="lax", secure=secure)
    return answer
