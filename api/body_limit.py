"""No request's body is longer than its route needs: what goes on for longer is cut off while it comes in."""

from __future__ import annotations

from typing import Any

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

BODY_BYTES = 1_000_000
"""Enough for the longest list of pulse widths; uploads have a bound of their own."""
UPLOAD = "/recordings"


class BodyLimit:
    """ASGI middleware: 413 once a body is over the bound.

    Parameters
    ----------
    context : Context
        Its settings hold the bound of uploads.
    """

    def __init__(self, app: ASGIApp, context: Any) -> None:
        self.app, self.context = app, context

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        upload = scope["path"].rstrip("/").endswith(UPLOAD)
        limit = int(self.context.settings.max_upload_mb * 1e6) if upload else BODY_BYTES
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > limit:
                raise HTTPException(413, f"At most {limit / 1e6:g} MB are taken here.")
            return message

        await self.app(scope, counted, send)
