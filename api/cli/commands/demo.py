"""`stimrig demo`: one whole pre-session test on the emulated rig, through REST, with its report."""

from __future__ import annotations

import json
import secrets
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli.commands.test import run_test
from stimrig.api.cli.errors import CommandError
from stimrig.api.cli.options import Emulate, Json, set_options
from stimrig.api.cli.reports import report_test
from stimrig.api.cli.supervisor import Services
from stimrig.api.cli.terminal import print_aside, report
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings

PARTICIPANT = "DEMO"


def demo(
    data: Annotated[Path | None, typer.Option(help="folder for its files; default var/demo/<time>")] = None,
    emulate: Emulate = "",
    as_json: Json = False,
) -> None:
    """One whole pre-session test on the emulated rig: serial line, CAN bus, REST, model, approval, fetch."""
    from stimrig.api.web.pages.report_file import comparison_html

    began = time.monotonic()
    folder = data or Path("var") / "demo" / datetime.now().strftime("%Y%m%d-%H%M%S")
    settings, token = Settings(**set_options(data_dir=folder, port=0) | {"rig_file": None}), secrets.token_urlsafe(32)
    print_aside("starting the emulated rig, the rig process and the service")
    with Services(settings, emulate.split(), token) as services, Client(services.url, token) as client:
        print_aside(f"service at {services.url}; participant {PARTICIPANT}; the test runs in real time")
        test = run_test(client, PARTICIPANT, services.watch)
        print_aside("approving the model; fetching it as the controller (ETag, then 304)")
        model = approve_and_fetch(client, test["model_id"])
        page = comparison_html(model, client.curves(test["model_id"]).to_dict(), test["id"], test)
    (recording,) = (folder / "recordings").glob(f"*{test['id']}*.h5")
    (folder / "MODEL.json").write_text(json.dumps(model, indent=1, ensure_ascii=False))
    (folder / "report.html").write_text(page)
    places = {"recording": recording, "model": folder / "MODEL.json", "report": folder / "report.html"}
    files = {name: str(path.absolute()) for name, path in (places | {"logs": folder / "logs"}).items()}
    seconds = round(time.monotonic() - began, 1)
    document = {"test": test, "model": model, "files": files, "seconds": seconds}
    listed = [f"{name:10} {path}" for name, path in files.items()]
    printed = identify.Model.from_dict(model)
    report(document, as_json, report_test(test), "", printed, "", *listed, f"done in {seconds} s")


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
