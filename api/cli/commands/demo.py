"""`stimrig demo`: one whole pre-session test on the emulated rig, through REST, with its report."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.errors import CommandError
from stimrig.api.cli.launcher import Services
from stimrig.api.cli.session_report import report_lines, run_test
from stimrig.api.cli.terminal import Json, number, say, say_json
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings

PARTICIPANT = "DEMO"


def demo(
    data: Annotated[Path | None, typer.Option(help="folder for its files; default var/demo/<time>")] = None,
    emulate: Annotated[str, typer.Option(help='options for the emulator, e.g. "--patient calcium"')] = "",
    as_json: Json = False,
) -> None:
    """One whole pre-session test on the emulated rig: serial line, CAN bus, REST, model, approval, fetch."""
    began = time.monotonic()
    tell: Callable[..., None] = (lambda *_: None) if as_json else say
    folder = data or Path("var") / "demo" / datetime.now().strftime("%Y%m%d-%H%M%S")
    token = secrets.token_urlsafe(32)
    settings = Settings(data_dir=folder, port=0, rig_file=None)
    tell("starting the emulated rig, the rig process and the service")
    with Services(settings, emulate.split(), token) as services:
        found = play(services, token, tell)
        found["files"] = write_files(folder, found)
    found["seconds"] = round(time.monotonic() - began, 1)
    if as_json:
        say_json(found)
        return
    shares = ", ".join(f"{name} {number(share, 1)} %" for name, share in found["cpu_percent"].items())
    say("", *report_lines(found["test"], found["model"]), f"processor      {shares} of a core during the test")
    say("", *[f"{name:14} {path}" for name, path in found["files"].items()])
    say(f"{'done in':14} {found['seconds']} s")


def play(services: Services, token: str, tell: Callable[..., None]) -> dict[str, Any]:
    """The whole path, over HTTP only."""
    with Client(services.url, token) as client:
        tell(f"service at {services.url}; participant {PARTICIPANT}; the test runs in real time")
        before, start = cpu(services), time.monotonic()
        test = run_test(client, PARTICIPANT, services.watch)
        spent = time.monotonic() - start
        after = cpu(services)
        tell("approving the model; fetching it as the controller (ETag, then 304)")
        model = approve_and_fetch(client, test["model_id"])
        curves = client.curves(test["model_id"])
    shares = {
        name: None if after[name] is None or used is None else round(100 * (after[name] - used) / spent, 1)
        for name, used in before.items()
    }
    return {"test": test, "model": model, "curves": curves, "cpu_percent": shares}


def approve_and_fetch(client: Client, model_id: str) -> dict[str, Any]:
    """A person approves; the controller fetches the model, and a second time hears that nothing changed.

    Raises CommandError: the controller did not get the approved model, or no 304.
    """
    client.approve(model_id, "demo")
    with Client(client.url, client.issue_token("controller", ["read-model"])) as controller:
        first = controller.approved_model(PARTICIPANT)
        again = controller.approved_model(PARTICIPANT, first)
    if first.document.get("model_id") != model_id:
        raise CommandError("the controller got another model than the approved one")
    if again.changed:
        raise CommandError("the service sent the model a second time, although nothing had changed")
    return first.document


def cpu(services: Services) -> dict[str, Any]:
    """Processor time of emulator and rig so far, s."""
    return {child.name: child.cpu_s() for child in (services.emulator, services.rig) if child is not None}


def write_files(folder: Path, found: dict[str, Any]) -> dict[str, str]:
    """The model, and a report with charts, beside the recording."""
    from stimrig.api.web.pages.report_file import comparison_html

    model_path, report_path = folder / "MODEL.json", folder / "report.html"
    model_path.write_text(json.dumps(found["model"], indent=1, ensure_ascii=False))
    report_path.write_text(comparison_html(found["model"], found.pop("curves"), found["test"]["id"], found["test"]))
    recording = next((folder / "recordings").glob(f"*{found['test']['id']}*.h5"), folder / "recordings")
    return {
        "recording": str(recording.absolute()),
        "model": str(model_path.absolute()),
        "report": str(report_path.absolute()),
        "logs": str((folder / "logs").absolute()),
    }
