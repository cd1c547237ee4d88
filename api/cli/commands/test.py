"""`stimrig test`: one pre-session test on the configured rig."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.errors import InputError
from api.cli.launcher import Services
from api.cli.session_report import report_lines, run_test
from api.cli.stop_key import StopKey, at_rig, at_service
from api.cli.terminal import Json, say, say_json
from api.client.rest import Client
from api.settings import Settings


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("test")(test)


def test(
    participant: Annotated[str, typer.Option(help="participant's code")] = "TEST",
    rig: Annotated[Path | None, typer.Option(help="rig file (TOML); default: the emulated rig")] = None,
    url: Annotated[str, typer.Option(help="a running service; default: one is started", envvar="STIMRIG_URL")] = "",
    data: Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")] = None,
    protocol: Annotated[str, typer.Option(help="which fixed test: paper, short")] = "paper",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write the recording (HDF5) here")] = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--patient calcium"')] = "",
    as_json: Json = False,
) -> None:
    """One pre-session test: a fixed protocol is played, and the muscle is identified. Approves nothing."""
    if url:
        token = os.environ.get("STIMRIG_TOKEN") or os.environ.get("STIMRIG_ADMIN_TOKEN")
        if not token:
            raise InputError(f"--url {url} needs a token in STIMRIG_TOKEN.")
        with StopKey(at_service(url, token), say_aside) as key:
            announce(key)
            found = through(url, token, participant, protocol)
    else:
        found = on_own_services(rig, data, emulate, participant, protocol)
    recording = found.pop("recording")
    if output is not None:
        save(output, recording)
    if as_json:
        say_json(found)
        return
    say(*report_lines(found["test"], found["model"]))
    say(f"recording      {output or found['test']['recording_url']}")


def announce(key: StopKey) -> None:
    """Say that a key stops, where one does."""
    if key.listens:
        say_aside("any key stops the test")


def say_aside(words: str) -> None:
    """On standard error, on a line of its own: standard output is the result's."""
    print(f"\r\x1b[K{words}" if sys.stderr.isatty() else words, file=sys.stderr, flush=True)


def save(path: Path, recording: bytes) -> None:
    """Write the recording.

    Raises
    ------
    InputError
        The place cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(recording)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Give a file in a folder that can be written.") from error


def on_own_services(
    rig: Path | None, data: Path | None, emulate: str, participant: str, protocol: str
) -> dict[str, Any]:
    """Start rig and service for this one test."""
    given = {"rig_file": rig, "data_dir": data}
    settings = Settings(**{key: value for key, value in given.items() if value is not None})
    settings.port = 0
    token = secrets.token_urlsafe(32)

    with (
        Services(settings, emulate.split(), token) as services,
        StopKey(at_rig(services.socket), say_aside) as key,
    ):
        announce(key)
        return through(services.url, token, participant, protocol, services.watch)


def through(
    url: str, token: str, participant: str, protocol: str = "paper", events: Callable[[], list[str]] = list
) -> dict[str, Any]:
    """The test through a service.

    Raises
    ------
    ServiceError
        The service cannot be reached, or the test did not end in a model.
    """
    with Client(url, token) as client:
        document = run_test(client, participant, events, protocol=protocol)
        model = client.model_file(document["model_id"])
        return {"test": document, "model": model, "recording": client.recording(document["recording_id"])}
