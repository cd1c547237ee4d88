"""In which language a page is written: the one that was chosen on a page, else one that the browser asks for."""

from __future__ import annotations

from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from api import language

COOKIE = "stimrig_language"
"""The choice; it says nothing about who chose."""


def chosen(headers: Headers) -> str:
    """The language for a request with these headers."""
    try:
        cookies = SimpleCookie(headers.get("cookie", "")[:4096])
    except CookieError:
        cookies = SimpleCookie()
    kept = cookies[COOKIE].value if COOKIE in cookies else ""
    return kept if kept in language.CODES else language.best(headers.get("accept-language", ""))


class PageLanguage:
    """ASGI middleware: sets the language for the request; `Headers`, around it, says it in the answer of a page."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        with language.using(chosen(Headers(scope=scope))):
            await self.app(scope, receive, send)
