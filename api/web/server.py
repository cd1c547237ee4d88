"""The service as a process: `main` prints one JSON line when it answers, and ends at SIGTERM.

Exit 2: a setting does not hold, another service holds the data, the port is taken, or the database does not open.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import socket
import sys
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from stimrig.api import logs
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.worker import limit_environment
from stimrig.api.settings import Settings, loopback
from stimrig.api.store.service_lock import ServiceLock
from stimrig.api.web.app import create_app

REQUEST_S = 10.0
MOST_SILENT = 256
MOST_FILES = 65_536


def main() -> int:
    """Run the service until SIGTERM or Ctrl-C; return the exit code."""
    logs.configure()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)  # each connection is a file
    max_files = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, max_files), hard))
    os.umask(os.umask(0o077) | 0o077)  # what the service and its workers write is for their user only
    try:
        settings = Settings()
        refuse_open_door(settings)
        lock = ServiceLock(settings)  # before the port: who runs already says more than a port that is taken
        limit_environment()
        listener = bind(settings.host, settings.port)
        host, port = listener.getsockname()[:2]
        url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
        lock.write_holder(url)
        if settings.effects_dir:  # before a first token is drawn: it is told only once
            asyncio.run(read_library())
        app = create_app(settings, lock=lock)
    except (ApiError, SettingsError, OSError) as error:
        print(f"stimrig: {error}", file=sys.stderr)
        return 2
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(app, listener, {"url": url, "port": port, "drawn_token": app.state.context.drawn_token}))
    return 0


async def read_library() -> None:
    """Have a worker read the library with the site's own effects. Raises ApiError: one cannot be used."""
    pool = Pool(1)
    try:
        await pool.submit("effects").result
    finally:
        await pool.close()


async def _serve(app: FastAPI, listener: socket.socket, ready: dict[str, object]) -> None:
    server = uvicorn.Server(configuration(app))
    running = asyncio.create_task(server.serve(sockets=[listener]))
    while not server.started and not running.done():
        await asyncio.sleep(0.01)
    if server.started:  # the first request would be answered
        print(json.dumps(ready), flush=True)
    await running


def configuration(app: ASGIApp, **more: Any) -> uvicorn.Config:
    """Return how uvicorn runs the service.

    `X-Forwarded-For` is believed of a proxy on this machine only: who signs in too often is told apart by address, and
    anybody could write another one into the header. Each request begins with no context variable set: on a connection
    that stays open it would else take over those of an earlier one.
    """
    usual: dict[str, Any] = {
        "log_config": None, "access_log": False, "timeout_graceful_shutdown": 2, "ws_max_size": 2**20,
        "server_header": False, "http": protocol(), "proxy_headers": True, "forwarded_allow_ips": ["127.0.0.1", "::1"],
        "reset_contextvars": True,
    }  # fmt: skip
    return uvicorn.Config(app, **usual | more)


def refuse_open_door(settings: Settings) -> None:
    """Refuse another address than loopback without a TLS proxy: passwords and tokens don't travel in the clear.

    Raises OSError: the host is not loopback, and TLS in front has not been vouched for.
    """
    if loopback(settings.host) or (settings.tls_proxy and settings.secure_cookies):
        return
    fix = (
        "listen on 127.0.0.1 and put the TLS proxy of deploy/nginx in front; if one stands in front on another "
        "machine, set STIMRIG_TLS_PROXY=true and STIMRIG_SECURE_COOKIES=true"
    )
    raise OSError(f"{settings.host}: refused, it is not this machine's loopback; {fix}")


def bind(host: str, port: int) -> socket.socket:
    """Take an address. Raises OSError with the fix: it cannot be had."""
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise OSError(f"{host}:{port}: {error.strerror or error}; take another port with --port") from error
    return listener


def protocol(request_s: float = REQUEST_S, most_silent: int = MOST_SILENT) -> type[H11Protocol]:
    """Return uvicorn's protocol, which closes connections that say nothing: they keep nobody out.

    A connection has `request_s` for the head of its first request, and as long for that of each next one. At most
    `most_silent` are waited for: when one more comes, the one that has been silent for longest is closed. So a newcomer
    always gets in, also with a stop, and the process does not run out of files.
    """
    silent: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    class Visitor(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:
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
