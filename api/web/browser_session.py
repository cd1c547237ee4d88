"""A browser's session: its cookie, where it may be opened from, where it leads back to."""

from __future__ import annotations

from urllib.parse import urlsplit

from fastapi import Request
from fastapi.responses import Response

from stimrig.api.errors import ApiError
from stimrig.api.web.dependencies import Context


def same_origin(request: Request) -> None:
    """Refuse a sign-in that another site's page sends: there is no session yet whose CSRF token could be asked for."""
    origin = request.headers.get("origin")
    if origin and urlsplit(origin).netloc != request.headers.get("host"):
        raise ApiError(403, "forbidden", "Not allowed", "The request came from a page of another site.")


def set_cookie(context: Context, answer: Response, cookie: str) -> None:
    """The session's cookie: not for scripts, not for other sites."""
    age_s, secure = int(context.auth.session_s), context.settings.secure_cookies
    name = context.auth.cookie_name
    answer.set_cookie(name, cookie, max_age=age_s, httponly=True, samesite="strict", secure=secure)


def local(target: str) -> str:
    """An address on this host, or the first page."""
    plain = target.startswith("/") and not target.startswith("//") and target.isprintable() and "\\" not in target
    return target if plain else "/"
