"""`stimrig serve`: the service and the page, with the rig, and the emulator where no rig file is given."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import DataDir, RigFile, set_options
from stimrig.api.cli.stop_key import StopKey, at_rig
from stimrig.api.cli.supervisor import Services
from stimrig.api.cli.terminal import print_lines
from stimrig.api.clock import Clock
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.settings import Settings
from stimrig.rig.messages import Status


def serve(
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="default 8000, or STIMRIG_PORT")] = None,
    host: Annotated[str | None, typer.Option(help="default 127.0.0.1, or STIMRIG_HOST")] = None,
    rig: RigFile = None,
    data: DataDir = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--hidden 7"')] = "",
) -> None:
    """The service and the page, until Ctrl-C or SIGTERM."""
    settings = Settings(**set_options(port=port, host=host, rig_file=rig, data_dir=data))
    if settings.rig_socket is not None and settings.rig_file is None:  # an emulated rig would stand in for that one
        raise InputError(
            f"STIMRIG_RIG_SOCKET is set ({settings.rig_socket}), but this verb starts a rig. For the rig at that "
            "socket start python -m stimrig.api.web; for the emulated rig unset STIMRIG_RIG_SOCKET."
        )
    services = Services(settings, emulate.split())
    with contextlib.suppress(KeyboardInterrupt), services:
        print_lines(*welcome(services, rig_status(services.socket)))
        try:
            with StopKey(at_rig(services.socket), print_lines) as key:
                if key.watched:
                    print_lines("any key stops a running test; Ctrl-C ends the service and the rig")
                while True:
                    time.sleep(0.2)
                    for event in services.watch():
                        print_lines(event)
        except KeyboardInterrupt:
            print_lines("stopping")


def rig_status(socket: Path) -> Status:
    """Ask the rig at a socket for its state. Raises ApiError: none answers there."""
    return asyncio.run(RigClient(socket, Clock()).fresh_status())


def welcome(services: Services, rig: Status) -> list[str]:
    """Write where the service is, how to get in, and what keeps the rig from working, if anything does."""
    settings, url, new_token = services.settings, services.url, services.api.ready["drawn_token"]
    devices = f"rig file {settings.rig_file}" if settings.rig_file else "the emulated rig"
    lines = [f"stimrig serves {url}/ with {devices}; data and logs in {settings.data_dir.absolute()}"]
    if new_token:
        lines += [f"first administrator's token, shown this once: {new_token}"]
        lines += [f"sign in: {url}/sign-in#token={new_token}"]
    elif settings.admin_token:
        lines += ["the administrator's token is the one in STIMRIG_ADMIN_TOKEN"]
    else:
        lines += ["sign in with a token issued before (set STIMRIG_ADMIN_TOKEN to replace a lost one)"]
    if services.emulator is not None:
        lines += [f"the emulator's control line: {services.emulator.ready['control']}"]
    return [*lines, *([] if rig.state == "ready" else [f"the rig is {rig.state}: {rig.reason or 'it is busy'}"])]
