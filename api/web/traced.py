"""Each request is the first step of a trace: its log lines carry the trace's id, and what changes something is told.

A trace context that a client sends is not taken over: it could hold anything.
"""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stimrig.api.traces import Tracer
from stimrig.api.web.middleware import SAFE_METHODS, HttpMiddleware


class Traced(HttpMiddleware):
    """`tracer`: what changes something is told to it, by the route's template: an address may name a participant."""

    def __init__(self, app: ASGIApp, tracer: Tracer) -> None:
        super().__init__(app)
        self._told, self._kept = tracer, Tracer()

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As the base class."""
        reads = scope["method"] in SAFE_METHODS
        with (self._kept if reads else self._told).step("HTTP", root=True) as says:

            async def send_more(message: Message) -> None:
                if message["type"] == "http.response.start":
                    says["http.response.status_code"] = message["status"]
                await send(message)

            try:
                await self.app(scope, receive, send_more)
            finally:
                template = getattr(scope.get("route"), "path", "")
                says |= {"http.request.method": scope["method"], "http.route": template}
                says["name"] = f"{scope['method']} {template}".strip()
