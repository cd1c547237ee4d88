"""`stimrig serve`: the service and the page, with the rig, and the emulator where no rig file is given."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Annotated

import typer

from api.launcher import Services
from api.settings import Settings
from api.terminal import say


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("serve")(serve)


def serve(
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="default 8000, or STIMRIG_PORT")] = None,
    host: Annotated[str | None, typer.Option(help="default 127.0.0.1, or STIMRIG_HOST")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: the emulated rig")] = None,
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--hidden 7"')] = "",
) -> None:
    """The service and the page, until Ctrl-C or SIGTERM."""
    given = {"port": port, "host": host, "rig_file": rig, "data_dir": data}
    settings = Settings(**{key: value for key, value in given.items() if value is not None})  # pyright: ignore[reportArgumentType]
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda caught, _frame: ended.append(caught))
    with Services(settings, emulate.split()) as services:
        say(*welcome(services, settings), *rig_state(services))
        while not ended:
            time.sleep(0.2)
            if not ended:
                for event in services.watch():
                    say(event)
        say("stopping")


def rig_state(services: Services) -> list[str]:
    """What keeps the rig from working, if anything does."""
    state = services.rig.ready.get("state", "ready")
    return [] if state == "ready" else [f"the rig is {state}: {services.rig.last_words()}"]


def welcome(services: Services, settings: Settings) -> list[str]:
    """Where it is, and how to get in."""
    devices = f"rig file {settings.rig_file}" if settings.rig_file else "the emulated rig"
    lines = [f"stimrig serves {services.url}/ with {devices}; data and logs in {settings.data_dir.absolute()}"]
    if services.drawn_token:
        lines += [
            f"first administrator's token, shown this once: {services.drawn_token}",
            f"sign in: {services.url}/sign-in#token={services.drawn_token}",
        ]
    elif settings.admin_token:
        lines.append("the administrator's token is the one in STIMRIG_ADMIN_TOKEN")
    else:
        lines.append("sign in with a token issued before (set STIMRIG_ADMIN_TOKEN to replace a lost one)")
    return lines
