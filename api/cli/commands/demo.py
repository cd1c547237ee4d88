"""`stimrig demo`: one whole pre-session test on the emulated rig, through REST, with its report."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.commands.test import run_test
from stimrig.api.cli.errors import CommandError
from stimrig.api.cli.options import Emulate, Json
from stimrig.api.cli.reports import report_test
from stimrig.api.cli.supervisor import Child, Services
from stimrig.api.cli.terminal import number, say, say_json
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings

PARTICIPANT = "DEMO"


def demo(
    data: Annotated[Path | None, typer.Option(help="folder for its files; default var/demo/<time>")] = None,
    emulate: Emulate = "",
    as_json: Json = False,
) -> None:
    """One whole pre-session test on the emulated rig: serial line, CAN bus, REST, model, approval, fetch."""
    began = time.monotonic()
    print_step: Callable[..., None] = (lambda *_: None) if as_json else say
    folder = data or Path("var") / "demo" / datetime.now().strftime("%Y%m%d-%H%M%S")
    token = secrets.token_urlsafe(32)
    print_step("starting the emulated rig, the rig process and the service")
    with Services(Settings(data_dir=folder, port=0, rig_file=None), emulate.split(), token) as services:
        result = play(services, token, print_step)
    result["files"] = write_files(folder, result)
    result["seconds"] = round(time.monotonic() - began, 1)
    if as_json:
        say_json(result)
        return
    shares = ", ".join(f"{name} {number(share, 1)} %" for name, share in result["cpu_percent"].items())
    say("", *report_test(result["test"], result["model"]), f"processor      {shares} of a core during the test")
    say("", *[f"{name:14} {path}" for name, path in result["files"].items()])
    say(f"{'done in':14} {result['seconds']} s")


def play(services: Services, token: str, print_step: Callable[..., None]) -> dict[str, Any]:
    """Go the whole path, over HTTP only."""
    children = [child for child in (services.emulator, services.rig) if child is not None]
    with Client(services.url, token) as client:
        print_step(f"service at {services.url}; participant {PARTICIPANT}; the test runs in real time")
        before, began = [_processor_s(child) for child in children], time.monotonic()
        test = run_test(client, PARTICIPANT, services.watch)
        percent = [100 / (time.monotonic() - began) * (_processor_s(child) - used)
                   for child, used in zip(children, before, strict=True)]  # fmt: skip
        print_step("approving the model; fetching it as the controller (ETag, then 304)")
        model = approve_and_fetch(client, test["model_id"])
        curves = client.curves(test["model_id"]).to_dict()
    shares = {child.name: round(share, 1) for child, share in zip(children, percent, strict=True)}
    return {"test": test, "model": model, "curves": curves, "cpu_percent": shares}


def _processor_s(child: Child) -> float:
    """Return the processor time used so far, s."""
    assert child.process is not None
    fields = Path(f"/proc/{child.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def approve_and_fetch(client: Client, model_id: str) -> dict[str, Any]:
    """Approve the model; fetch it as the controller, and a second time, when nothing has changed.

    Raises CommandError: the controller did not get the approved model, or no 304.
    """
    client.approve(model_id, "demo")
    with Client(client.url, client.issue_token("controller", ["read-model"])) as controller:
        first = controller.approved_model(PARTICIPANT)
        second = controller.approved_model(PARTICIPANT, first)
    if first.document.get("model_id") != model_id:
        raise CommandError("the controller got another model than the approved one")
    if second.changed:
        raise CommandError("the service sent the model a second time, although nothing had changed")
    return first.document


def write_files(folder: Path, result: dict[str, Any]) -> dict[str, str]:
    """Write the model, and a report with charts, beside the recording; return where each file is."""
    from stimrig.api.web.pages.report_file import comparison_html

    model, report, test = folder / "MODEL.json", folder / "report.html", result["test"]
    model.write_text(json.dumps(result["model"], indent=1, ensure_ascii=False))
    report.write_text(comparison_html(result["model"], result.pop("curves"), test["id"], test))
    recording = next((folder / "recordings").glob(f"*{test['id']}*.h5"), folder / "recordings")
    files = {"recording": recording, "model": model, "report": report, "logs": folder / "logs"}
    return {name: str(path.absolute()) for name, path in files.items()}
