"""JSON in a request is read strictly before any route sees it: UTF-8, no deeper than a request of ours, no key twice.

Of two limits in one object the last would count, and nobody could tell which one was meant. A form is UTF-8, too: what
other codecs make of it is no text that can be kept.
"""

from __future__ import annotations

import asyncio
import json
import re
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.web.body_limit import UPLOAD
from stimrig.identify.strict_json import BadJson, NotJson, parse

DEEPEST = 16
"""Brackets within one another: a test's segment's settings take six."""
PARSED = "stimrig.json"
"""Where the scope of a request has what was read."""
SHORT = 16_384
"""Bytes that are read in less than a millisecond or two."""
_READER = ThreadPoolExecutor(1, "long-bodies")
UTF_8 = re.compile(r';\s*charset="?utf-8"?(?=;|\s|$)')
REFUSALS = {
    "400": "the body is not UTF-8, begins with a byte-order mark, is too deep, or has a key twice",
    "408": "the body did not come in time",
    "413": "the body is too long",
}


class StrictBody:
    """ASGI middleware: 400 for JSON that is not sound; stands inside `BodyLimit`, which bounds what it holds."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = Headers(scope=scope).get("content-type", "json").lower() if scope["type"] == "http" else ""
        if "form" in kind and "charset" in UTF_8.sub("", kind):
            await self.app(scope, _refused, send)
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
                    scope[PARSED] = sound(bytes(body))
                else:  # one at a time: a stop, which waits for the event loop, comes between
                    scope[PARSED] = await asyncio.get_running_loop().run_in_executor(_READER, sound, bytes(body))
            return message

        await self.app(scope, checked, send)


async def _refused() -> Message:
    """Where the body should come: whoever reads it is told, and a stop, which needs none, is a stop all the same."""
    raise HTTPException(400, "The form is not in UTF-8. Send it in UTF-8, as browsers do.")


def sound(body: bytes) -> Any:
    """What JSON says; None where it says nothing. Refused where it would be read in two ways, or no route takes it.

    Raises
    ------
    HTTPException
        400, with what is wrong in one line.
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
