"""`python -m stimrig.api.centre.server`: the centre's process. Prints one JSON line when it answers; ends at SIGTERM.

Exit 2: a setting does not hold, the port is taken, the database does not open, the bucket is not there.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from stimrig.api import logs
from stimrig.api.centre.app import create_app
from stimrig.api.centre.context import CentreSettings
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.web import server


def main() -> int:
    logs.configure("centre")
    try:
        app, listener = prepared(CentreSettings())
    except (ApiError, SettingsError, OSError) as error:
        print(f"stimrig: {error}", file=sys.stderr)
        return 2
    run(app, listener)
    return 0


def prepared(settings: CentreSettings) -> tuple[FastAPI, socket.socket]:
    """The application, and the address it will answer at.

    Raises ApiError, SettingsError, OSError: one line each: what is wrong, and the fix.
    """
    server.raise_file_limit()
    os.umask(os.umask(0o077) | 0o077)  # what the centre writes is for its user only
    server.refuse_open_door(settings)
    listener = server.bind(settings.host, settings.port)
    try:
        return create_app(settings), listener
    except BaseException:
        listener.close()
        raise


def run(app: FastAPI, listener: socket.socket, ready: Callable[[str], object] | None = None) -> None:
    """Serve until SIGTERM or Ctrl-C; `ready` is told the address, else a JSON line."""
    signal.signal(signal.SIGTERM, lambda _number, _frame: None)  # uvicorn ends in order, and raises it once more
    if ready is None:
        server.run(app, listener)
        return
    ready(server.address_of(listener))
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(uvicorn.Server(server.configuration(app)).serve(sockets=[listener]))


if __name__ == "__main__":
    sys.exit(main())
