"""`stimrig serve`: the service and the page, with the rig, and the emulator where no rig file is given."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.launcher import Ended, Services
from stimrig.api.cli.stop_key import StopKey, at_rig
from stimrig.api.cli.terminal import given, say, sign_in_lines
from stimrig.api.settings import Settings
from stimrig.rig.messages import Status


def serve(
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="default 8000, or STIMRIG_PORT")] = None,
    host: Annotated[str | None, typer.Option(help="default 127.0.0.1, or STIMRIG_HOST")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: the emulated rig")] = None,
    rig_socket: Annotated[
        Path | None, typer.Option(help="use the running rig that listens here; or STIMRIG_RIG_SOCKET")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--hidden 7"')] = "",
) -> None:
    """The service and the page, until Ctrl-C or SIGTERM."""
    named = given(port=port, host=host, rig_file=rig, rig_socket=rig_socket, data_dir=data)
    settings = Settings(**named)
    found = attachable(settings, emulate) if settings.rig_socket else None
    with contextlib.suppress(Ended), Services(settings, emulate.split(), attach=settings.rig_socket) as services:
        say(*welcome(services, settings), *rig_state(services, found))
        try:
            with StopKey(at_rig(services.socket), say) as key:
                if key.watched:
                    say("any key stops a running test; Ctrl-C ends the service" + ("" if found else " and the rig"))
                while True:
                    time.sleep(0.2)
                    for event in services.watch():
                        say(event)
        except Ended:
            say("stopping" + ("; the rig goes on by itself" if found else ""))


def attachable(settings: Settings, emulate: str) -> Status:
    """The state of the rig that runs already.

    Raises InputError: a rig to be started was named, too, or none listens at the socket.
    """
    from stimrig.api.clock import Clock
    from stimrig.api.errors import ApiError
    from stimrig.api.sessions.rig_client import RigClient

    place = settings.rig_socket
    if settings.rig_file is not None or emulate.strip():
        other = f"--rig {settings.rig_file}" if settings.rig_file is not None else "--emulate"
        raise InputError(
            f"--rig-socket {place} attaches to a rig that runs, {other} starts one: give one of them "
            "(STIMRIG_RIG_SOCKET and STIMRIG_RIG_FILE count, too)."
        )
    try:
        return asyncio.run(RigClient(place, Clock()).fresh_status())
    except ApiError as error:
        raise InputError(
            f"--rig-socket {place}: no rig answers there ({error.detail}) Start it first: "
            f"python -m stimrig.rig --config RIG.toml --data DIR --socket {place}"
        ) from error


def rig_state(services: Services, found: Status | None = None) -> list[str]:
    """What keeps the rig from working, if anything does."""
    if found is not None:
        return [] if found.state == "ready" else [f"the rig is {found.state}: {found.reason or 'it is busy'}"]
    state = services.rig.ready.get("state", "ready")
    return [] if state == "ready" else [f"the rig is {state}: {services.rig.last_words()}"]


def welcome(services: Services, settings: Settings) -> list[str]:
    """Where it is, and how to get in."""
    devices = f"rig file {settings.rig_file}" if settings.rig_file else "the emulated rig"
    if services.attached:
        devices = f"the rig at {settings.rig_socket}"
    lines = [f"stimrig serves {services.url}/ with {devices}; data and logs in {settings.data_dir.absolute()}"]
    lines += sign_in_lines(services.url, services.drawn_token, bool(settings.admin_token), "STIMRIG_ADMIN_TOKEN")
    if services.control_line:
        lines.append(f"the emulator's control line: {services.control_line}")
    return lines
