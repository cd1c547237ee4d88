"""A deprecated route says so in the headers of each answer (`stimrig.deprecations`)."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig import deprecations


class Deprecated:
    """Middleware; costs nothing where no route is deprecated."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        found = deprecations.headers_of(scope["method"], scope["path"]) if scope["type"] == "http" else {}

        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(found)
            await send(message)

        await self.app(scope, receive, told if found else send)
