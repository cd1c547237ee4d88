"""What comes in is bounded: no body is longer than its route needs or takes longer to come, and of previews, whose
bodies are long and whose answers are longer, only so many are taken at once.
"""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.clock import asked_s
from stimrig.api.errors import ApiError

BODY_BYTES = 1_000_000
"""Enough for the longest list of pulse widths; uploads have a bound of their own."""
BODY_S, UPLOAD_S = 20.0, 300.0
UPLOAD = "/recordings"
PREVIEW = "/v1/preview"
MOST_PREVIEWS = 4
"""In work at the same time; the next ones are refused before they are read."""


class BodyLimit:
    """ASGI middleware: 413 once a body is over the bound, 408 when it does not come, 503 for too many previews.

    Parameters
    ----------
    context : Context
        Its settings hold the bound of uploads.
    """

    def __init__(self, app: ASGIApp, context: Any) -> None:
        self.app, self.context = app, context
        self._previews = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        asked_s.set(self.context.clock.monotonic_s())  # before anything waits
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

    def bounds(self, path: str) -> tuple[int, float]:
        """Most bytes that a route takes, and for how long it waits for them, s."""
        if path.rstrip("/").endswith(UPLOAD):
            return int(self.context.settings.max_upload_mb * 1e6), UPLOAD_S
        return BODY_BYTES, BODY_S

    def _bounded(self, scope: Scope, receive: Receive) -> Receive:
        limit, patience_s = self.bounds(scope["path"])
        loop = asyncio.get_running_loop()
        end_s = loop.time() + patience_s
        taken, whole = 0, False

        async def bounded() -> Message:
            nonlocal taken, whole
            try:
                async with asyncio.timeout_at(None if whole else end_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, "The request was not complete in time. Send it again.") from None
            taken += len(message.get("body", b""))
            whole = not message.get("more_body", False)
            if taken > limit:
                raise HTTPException(413, f"At most {limit / 1e6:g} MB are taken here.")
            return message

        return bounded


def crowded() -> JSONResponse:
    """503: others' previews are in work."""
    detail = f"{MOST_PREVIEWS} previews are being worked out already. Try again in a second."
    problem = ApiError(503, "crowded", "Too many previews at once", detail)
    return JSONResponse(problem.body(PREVIEW), 503, media_type="application/problem+json", headers={"Retry-After": "1"})
