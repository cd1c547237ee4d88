"""Middleware of every route: bounds and strict JSON for requests, headers for responses."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import secrets
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.clock import request_received_s
from stimrig.api.errors import ApiError
from stimrig.api.logs import current_request
from stimrig.identify.json_text import BadJson, NotJson, parse

log = logging.getLogger("stimrig.api")
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
STOP, UPLOAD = "/v1/stop", "/recordings"
"""Addresses that are treated in their own way; an upload's ends so."""

NOWHERE = "base-uri 'none'; frame-ancestors 'none'"
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; connect-src 'self'; form-action 'self'; "
    # plotly writes styles into its drawings, and keeps a picture of a chart as data of the page's own
    f"style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; {NOWHERE}"
)
ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",  # where the route knows nothing better
}
PAGE = {
    **ALWAYS,
    "Content-Security-Policy": PAGE_POLICY,
    "Referrer-Policy": "same-origin",  # with no-referrer a form's Origin is "null", and `same_origin` looks at it
    "Content-Language": "en",
}
DATA = {  # should a browser be led to show it
    **ALWAYS,
    "Content-Security-Policy": f"default-src 'none'; form-action 'none'; {NOWHERE}",
    "Referrer-Policy": "no-referrer",
}

BODY_BYTES, BODY_S, UPLOAD_S = 1_000_000, 20.0, 300.0
"""Enough for the longest list of pulse widths; uploads have a bound of their own."""
MOST_UPLOADS = 8
"""In work at the same time: bodies and answers are long; further ones are refused before they are read."""
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


class Boundary:
    """ASGI middleware around the application, the answer to an unexpected error included.

    A request gets an id, which its log lines carry; one that a client sends could hold anything. Its body is bounded
    and read strictly. Its answer gets the headers that a route has not set itself. Before a change is answered, what
    plays is looked at again: nothing begins on what has been answered as changed; a stop waits for nothing.

    `context`: the application's parts.
    """

    def __init__(self, app: ASGIApp, context: Any) -> None:
        self.app, self.context = app, context
        self._uploads = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        current_request.set(secrets.token_hex(8))
        request_received_s.set(self.context.clock.monotonic_s())  # before anything waits
        changes = scope["method"] not in SAFE_METHODS and scope["path"] != STOP

        async def send_more(message: Message) -> None:
            if message["type"] == "http.response.start":
                if changes:
                    await self._look_again()
                add_headers(MutableHeaders(scope=message))
            await send(message)

        path = scope["path"].rstrip("/")
        uploads = path.endswith(UPLOAD)
        if uploads and self._uploads >= MOST_UPLOADS:
            await crowded(path)(scope, receive, send_more)
            return
        self._uploads += uploads
        try:
            await self.app(scope, self._bounded(scope, receive), send_more)
        finally:
            self._uploads -= uploads

    async def _look_again(self) -> None:
        try:
            await self.context.runner.look_again()
        except Exception:  # what was done is answered; it is looked at again four times a second
            log.exception("whether a test may still be played could not be seen")

    def _bounded(self, scope: Scope, receive: Receive) -> Receive:
        """Receive a body: 413 once it is over the bound, 408 when it does not come, 400 where it is not sound.

        The error is raised where the body is read: a stop, which needs none, is a stop all the same.
        """
        upload = scope["path"].rstrip("/").endswith(UPLOAD)
        limit = int(self.context.settings.max_upload_mb * 1e6) if upload else BODY_BYTES
        end_s = asyncio.get_running_loop().time() + (UPLOAD_S if upload else BODY_S)
        kind = Headers(scope=scope).get("content-type", "json").lower()
        strict = "json" in kind and not upload
        body, received, whole = bytearray(), 0, False

        async def bounded() -> Message:
            nonlocal received, whole
            if "form" in kind and "charset" in UTF_8.sub("", kind):  # what other codecs make of it is no text to keep
                raise HTTPException(400, "The form is not in UTF-8. Send it in UTF-8, as browsers do.")
            try:
                async with asyncio.timeout_at(None if whole else end_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, "The request was not complete in time. Send it again.") from None
            part = message.get("body", b"")
            received += len(part)
            whole = not message.get("more_body", False)
            if received > limit:
                raise HTTPException(413, f"At most {limit / 1e6:g} MB are taken here.")
            if strict and message["type"] == "http.request":
                body.extend(part)
                if whole and len(body) <= SHORT:
                    refuse_unsound(bytes(body))
                elif whole:  # one at a time: a stop, which waits for the event loop, comes between
                    await asyncio.get_running_loop().run_in_executor(_READER, refuse_unsound, bytes(body))
            return message

        return bounded


def add_headers(headers: MutableHeaders) -> None:
    """Tell a browser to load from and post to this service alone, guess nothing, and keep nothing private."""
    page = headers.get("content-type", "").startswith("text/html")
    for name, value in (PAGE if page else DATA).items():
        headers.setdefault(name, value)
    if page:
        headers.add_vary_header("Cookie")


def crowded(path: str) -> JSONResponse:
    """503: others' uploads are in work."""
    detail = f"{MOST_UPLOADS} uploads are in work already. Try again in 30 s."
    body = ApiError(503, "crowded", "Too many uploads at once", detail).body(path)
    return JSONResponse(body, 503, media_type="application/problem+json", headers={"Retry-After": "30"})


def refuse_unsound(body: bytes) -> None:
    """Refuse JSON that is not UTF-8, is too deep, or has a key twice: of two limits in one object the last would count.

    What is no JSON at all passes: the route names the field and the place. Raises HTTPException: 400, with what is
    wrong in one line.
    """
    if not body.strip():
        return
    if json.detect_encoding(body) != "utf-8":  # as the route's reader guesses it: that would decode it, unchecked
        detail = "The body is in UTF-16 or UTF-32, or begins with a byte-order mark. Send JSON (RFC 8259) in UTF-8."
        raise HTTPException(400, detail)
    try:
        parse(body, deepest=DEEPEST, finite=False)
    except NotJson:
        pass
    except BadJson as error:
        raise HTTPException(400, f"The body: {error}. Send JSON (RFC 8259) in UTF-8.") from error


def entity_tags(field: str) -> list[str]:
    """The tags of `If-None-Match`, each in its quotes; a proxy that compresses marks them as weak."""
    return [tag.strip().removeprefix("W/") for tag in field.split(",")]


def wants_html(request: HTTPConnection) -> bool:
    """Return whether a browser's navigation or form sent the request."""
    return "text/html" in request.headers.get("accept", "")
