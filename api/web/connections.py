"""The service's door: a crowd of connections that say nothing does not keep out one who has something to say.

A connection has `REQUEST_S` for the head of its first request, and as long for that of each next one. Then it is
closed. At most `MOST_SILENT` connections are waited for. When one more comes, the one that has been silent for longest
is closed. So a newcomer always gets in, also with a stop, and the process does not run out of files.
"""

from __future__ import annotations

import asyncio
import resource

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0
MOST_SILENT = 256
MOST_FILES = 65_536


def protocol(request_s: float = REQUEST_S, most_silent: int = MOST_SILENT) -> type[H11Protocol]:
    """The protocol that uvicorn is to speak: its own, at such a door."""
    silent: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    class Visitor(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            super().connection_made(transport)
            self._wait()

        def connection_lost(self, exc: Exception | None) -> None:
            self._waited()
            super().connection_lost(exc)

        def handle_events(self) -> None:
            before = self.cycle
            super().handle_events()
            if self.cycle is not before and not self.cycle.response_complete:
                self._waited()

        def handle_websocket_upgrade(self, event: h11.Request) -> None:
            self._waited()
            super().handle_websocket_upgrade(event)

        def on_response_complete(self) -> None:
            super().on_response_complete()
            served = self.cycle is not None and not self.cycle.response_complete  # the next one had come already
            if not self.transport.is_closing() and self.transport.get_protocol() is self and not served:
                self._wait()

        def _wait(self) -> None:
            self._waited()
            silent[self.transport] = self.loop.call_later(request_s, self.transport.abort)
            if len(silent) > most_silent:
                longest = next(iter(silent))
                silent.pop(longest).cancel()
                longest.abort()

        def _waited(self) -> None:
            timer = silent.pop(self.transport, None)
            if timer is not None:
                timer.cancel()

    return Visitor


def raise_file_limit() -> None:
    """As many open files as this process may have: each connection is one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
