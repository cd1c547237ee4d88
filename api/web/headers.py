"""What every answer tells a browser: load from and post to this service alone, guess nothing, keep nothing private.

And in which language a page is written: the one that was chosen on a page, else one that the browser asks for.
"""

from __future__ import annotations

from http.cookies import CookieError, SimpleCookie

from starlette import datastructures
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api import language

COOKIE = "stimrig_language"
"""The choice; it says nothing about who chose."""
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""A page's. plotly writes styles into its drawings, and keeps a picture of a chart as data of the page's own."""
DATA_POLICY = "default-src 'none'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
"""Everything else's, should a browser be led to show it."""
ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",  # where the route knows nothing better
}
PAGE = {
    **ALWAYS,
    "Content-Security-Policy": PAGE_POLICY,
    "Referrer-Policy": "same-origin",  # with no-referrer a form's Origin is "null", and the door asks for it
}
DATA = {**ALWAYS, "Content-Security-Policy": DATA_POLICY, "Referrer-Policy": "no-referrer"}


def entity_tags(field: str) -> list[str]:
    """The tags of `If-Match` or `If-None-Match`, each in its quotes; a proxy that compresses marks them as weak.

    `If-Match` asks for strong ones (RFC 9110, section 13.1.1). Ours stand for what was said, not for its bytes: a weak
    one means the same.
    """
    return [tag.strip().removeprefix("W/") for tag in field.split(",")]


def wants_html(request: HTTPConnection) -> bool:
    """Whether a browser's navigation or form asked, not a program."""
    return "text/html" in request.headers.get("accept", "")


class Headers:
    """ASGI middleware: a header that a route has set itself stays as it is."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = datastructures.MutableHeaders(scope=message)
                page = headers.get("content-type", "").startswith("text/html")
                for name, value in (PAGE if page else DATA).items():
                    headers.setdefault(name, value)
                if page:
                    headers.setdefault("Content-Language", language.code())
                    headers.add_vary_header("Accept-Language")
                    headers.add_vary_header("Cookie")
            await send(message)

        await self.app(scope, receive, told)


def chosen_language(headers: datastructures.Headers) -> str:
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
        with language.using(chosen_language(datastructures.Headers(scope=scope))):
            await self.app(scope, receive, send)
