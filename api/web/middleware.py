"""What stands around every route: bounds and strict JSON for what comes in, headers for what goes out."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import secrets
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from starlette import datastructures
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.clock import request_received_s
from stimrig.api.errors import ApiError
from stimrig.api.logs import current_request
from stimrig.identify.json_text import BadJson, NotJson, parse

log = logging.getLogger("stimrig.look_again")
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
STOP, PREVIEW, UPLOAD = "/v1/stop", "/v1/preview", "/recordings"
"""Addresses that are treated in their own way; an upload's ends so."""


class HttpMiddleware:
    """ASGI middleware for HTTP; what is none passes by. `serve` is what each of them does.

    `context`: the application's parts, for those that need them.
    """

    def __init__(self, app: ASGIApp, context: Any = None) -> None:
        self.app, self.context = app, context

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self.serve if scope["type"] == "http" else self.app)(scope, receive, send)

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        raise NotImplementedError


# ---- what every answer tells a browser: load from and post to this service alone, guess nothing, keep nothing private


def policy(*parts: str) -> str:
    """A Content-Security-Policy."""
    return "; ".join(parts)


NOTHING, NOWHERE = policy("default-src 'none'"), policy("base-uri 'none'", "frame-ancestors 'none'")
DRAWS = policy("style-src 'self' 'unsafe-inline'", "img-src 'self' data: blob:")
"""plotly writes styles into its drawings, and keeps a picture of a chart as data of the page's own."""
PAGE_POLICY = policy(NOTHING, "script-src 'self'", DRAWS, "connect-src 'self'", "form-action 'self'", NOWHERE)
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
DATA = {  # should a browser be led to show it
    **ALWAYS,
    "Content-Security-Policy": policy(NOTHING, "form-action 'none'", NOWHERE),
    "Referrer-Policy": "no-referrer",
}


class Headers(HttpMiddleware):
    """A header that a route has set itself stays as it is."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""

        async def send_more(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = datastructures.MutableHeaders(scope=message)
                page = headers.get("content-type", "").startswith("text/html")
                for name, value in (PAGE if page else DATA).items():
                    headers.setdefault(name, value)
                if page:
                    headers.setdefault("Content-Language", "en")
                    headers.add_vary_header("Cookie")
            await send(message)

        await self.app(scope, receive, send_more)


def entity_tags(field: str) -> list[str]:
    """The tags of `If-Match` or `If-None-Match`, each in its quotes; a proxy that compresses marks them as weak.

    `If-Match` asks for strong ones (RFC 9110, section 13.1.1). Ours stand for what was said, not for its bytes: a weak
    one means the same.
    """
    return [tag.strip().removeprefix("W/") for tag in field.split(",")]


def wants_html(request: HTTPConnection) -> bool:
    """Return whether a browser's navigation or form sent the request."""
    return "text/html" in request.headers.get("accept", "")


# ---- no body is longer than its route needs, or takes longer to come ------------------------------------------------

BODY_BYTES = 1_000_000
"""Enough for the longest list of pulse widths; uploads have a bound of their own."""
BODY_S, UPLOAD_S = 20.0, 300.0
MOST_PREVIEWS = 4
"""In work at the same time: their bodies are long, their answers longer; the next ones are refused before they are
read."""


class BodyLimit(HttpMiddleware):
    """413 once a body is over the bound, 408 when it does not come, 503 for too many previews."""

    def __init__(self, app: ASGIApp, context: Any) -> None:
        super().__init__(app, context)
        self._previews = 0

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""
        request_received_s.set(self.context.clock.monotonic_s())  # before anything waits
        bounded = self._bounded(scope, receive)
        if scope["path"].rstrip("/") != PREVIEW:
            await self.app(scope, bounded, send)
            return
        if self._previews >= MOST_PREVIEWS:
            await crowded()(scope, receive, send)
            return
        self._previews += 1
        try:
            await self.app(scope, bounded, send)
        finally:
            self._previews -= 1

    def _bounded(self, scope: Scope, receive: Receive) -> Receive:
        limit, patience_s = BODY_BYTES, BODY_S
        if scope["path"].rstrip("/").endswith(UPLOAD):
            limit, patience_s = int(self.context.settings.max_upload_mb * 1e6), UPLOAD_S
        end_s = asyncio.get_running_loop().time() + patience_s
        received, whole = 0, False

        async def bounded() -> Message:
            nonlocal received, whole
            try:
                async with asyncio.timeout_at(None if whole else end_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, "The request was not complete in time. Send it again.") from None
            received += len(message.get("body", b""))
            whole = not message.get("more_body", False)
            if received > limit:
                raise HTTPException(413, f"At most {limit / 1e6:g} MB are taken here.")
            return message

        return bounded


def crowded() -> JSONResponse:
    """503: others' previews are in work."""
    detail = f"{MOST_PREVIEWS} previews are being worked out already. Try again in a second."
    problem = ApiError(503, "crowded", "Too many previews at once", detail)
    return JSONResponse(problem.body(PREVIEW), 503, media_type="application/problem+json", headers={"Retry-After": "1"})


# ---- JSON is read strictly before any route sees it ------------------------------------------------------------------

DEEPEST = 16
"""Brackets within one another: a test's segment's settings take six."""
SHORT = 16_384
"""Bytes that are read in less than a millisecond or two."""
_READER = ThreadPoolExecutor(1, "long-bodies")
UTF_8 = re.compile(r';\s*charset="?utf-8"?(?=;|\s|$)')
REFUSALS = {
    "400": "the body is not UTF-8, begins with a byte-order mark, is too deep, or has a key twice",
    "408": "the body did not come in time",
    "413": "the body is too long",
}


class RequestId(HttpMiddleware):
    """Give each request an id of its own, which its log lines carry; an id that a client sends could hold anything."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""
        current_request.set(secrets.token_hex(8))
        await self.app(scope, receive, send)


class StrictBody(HttpMiddleware):
    """400 for JSON that is not sound: UTF-8, no deeper than a request of ours, no key twice.

    Of two limits in one object the last would count, and nobody could tell which one was meant. A form is UTF-8, too:
    what other codecs make of it is no text that can be kept. Stands inside `BodyLimit`, which bounds what it holds.
    """

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""
        kind = datastructures.Headers(scope=scope).get("content-type", "json").lower()
        if "form" in kind and "charset" in UTF_8.sub("", kind):
            await self.app(scope, _refuse_form, send)
            return
        if "json" not in kind or scope["path"].rstrip("/").endswith(UPLOAD):
            await self.app(scope, receive, send)
            return
        body = bytearray()

        async def checked() -> Message:
            message = await receive()
            body.extend(message.get("body", b""))
            if message["type"] == "http.request" and not message.get("more_body"):
                if len(body) <= SHORT:
                    sound(bytes(body))
                else:  # one at a time: a stop, which waits for the event loop, comes between
                    await asyncio.get_running_loop().run_in_executor(_READER, sound, bytes(body))
            return message

        await self.app(scope, checked, send)


async def _refuse_form() -> Message:
    """Where the body should come: whoever reads it is told, and a stop, which needs none, is a stop all the same."""
    raise HTTPException(400, "The form is not in UTF-8. Send it in UTF-8, as browsers do.")


def sound(body: bytes) -> Any:
    """Return the parsed JSON; None for an empty or invalid body, which the route refuses with the field's name.

    Raises HTTPException: 400, with what is wrong in one line.
    """
    if not body.strip():
        return None
    if json.detect_encoding(body) != "utf-8":  # as the route's reader guesses it: that would decode it, unchecked
        detail = "The body is in UTF-16 or UTF-32, or begins with a byte-order mark. Send JSON (RFC 8259) in UTF-8."
        raise HTTPException(400, detail)
    try:
        return parse(body, deepest=DEEPEST, finite=False)
    except NotJson:
        return None  # the route names the field and the place
    except BadJson as error:
        raise HTTPException(400, f"The body: {error}. Send JSON (RFC 8259) in UTF-8.") from error


# ---- before a change is answered, what plays is looked at again ------------------------------------------------------


class LookAgain(HttpMiddleware):
    """Nothing begins on what has been answered as changed; a stop waits for nothing."""

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""
        if scope["method"] in SAFE_METHODS or scope["path"] == STOP:
            await self.app(scope, receive, send)
            return

        async def look_and_send(message: Message) -> None:
            if message["type"] == "http.response.start":
                try:
                    await self.context.runner.look_again()
                except Exception:  # what was done is answered; it is looked at again four times a second
                    log.exception("whether a test may still be played could not be seen")
            await send(message)

        await self.app(scope, receive, look_and_send)
