"""A pre-session test through REST alone, as a clinician's program would do it, with its printed report."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import httpx

from api.cli.errors import ReportedError
from api.cli.terminal import number

Watch = Callable[[], object]


def checked(response: httpx.Response) -> httpx.Response:
    """The answer, or its problem's words raised."""
    if response.is_success or response.status_code == 304:
        return response
    try:
        problem = response.json()
        words = f"{problem['title']}: {problem['detail']}"
    except (ValueError, KeyError, TypeError):
        words = response.text[:200]
    code = 2 if response.status_code in (401, 403, 404, 422) or "rig-disconnected" in response.text else 1
    raise ReportedError(f"{response.request.method} {response.request.url.path}: {words}", code)


def ensure_participant(client: httpx.Client, code: str) -> None:
    """Make the participant unless it is there."""
    if client.get(f"/v1/participants/{code}").status_code == 404:
        checked(client.post("/v1/participants", json={"code": code}))


def run_test(client: httpx.Client, participant: str, watch: Watch = lambda: None, **more: Any) -> dict[str, Any]:
    """Start a test (the default pre-session test unless more is asked for) and follow it to its model.

    Parameters
    ----------
    client : httpx.Client
        With the service's address and a token.
    participant : str
        Code.
    watch : callable
        Called at each poll; raises where a process has ended.
    **more
        Further fields of the request: kind, segments, joins.

    Raises
    ------
    ReportedError
        The test was refused, or did not end in a model.
    """
    location = checked(client.post("/v1/tests", json={"participant": participant, **more})).headers["location"]
    document: dict[str, Any] = {}
    show = Progress()
    while not document.get("done"):
        watch()
        document = checked(client.get(location)).json()
        show(document)
        time.sleep(0.1)
    if document["state"] != "completed":
        raise ReportedError(f"the test ended as {document['state']}: {document['reason'] or 'no reason was given'}")
    return document


class Progress:
    """A progress line: on a terminal in place, elsewhere a line a segment."""

    def __init__(self) -> None:
        self.terminal = sys.stderr.isatty()
        self.last = ""

    def __call__(self, document: dict[str, Any]) -> None:
        """Show where the test stands."""
        if document["state"] == "identifying":
            segment = (document.get("identification") or {}).get("text") or "identifying"
            words = f"identification: {segment}"
        else:
            segment = document.get("segment") or document["state"]
            words = f"{segment:10} {100 * document['progress']:3.0f} %  {document['time_left_s']:4.0f} s left"
        if self.terminal:
            words, end = (document["state"], "\n") if document["done"] else (words, "")
            print(f"\r\x1b[K  {words}", end=end, file=sys.stderr, flush=True)
        elif segment != self.last and not document["done"]:
            print(f"  {words}", file=sys.stderr, flush=True)
        self.last = segment


def approve_and_fetch(
    client: httpx.Client, controller: httpx.Client, participant: str, model_id: str
) -> dict[str, Any]:
    """A person approves; the controller fetches the model, and a second time hears that nothing changed.

    Raises
    ------
    ReportedError
        The controller did not get the approved model, or no 304.
    """
    checked(client.post(f"/v1/models/{model_id}/approve", json={"reason": "demo"}))
    first = checked(controller.get(f"/v1/participants/{participant}/model"))
    if first.json().get("model_id") != model_id:
        raise ReportedError("the controller got another model than the approved one")
    again = controller.get(f"/v1/participants/{participant}/model", headers={"If-None-Match": first.headers["etag"]})
    if again.status_code != 304:
        raise ReportedError(f"the controller's second fetch was answered with {again.status_code}, not 304")
    return first.json()


def report_lines(test: dict[str, Any], model: dict[str, Any]) -> list[str]:
    """The report of a test and its model."""
    summary, planned = test["summary"], test.get("planned") or {}
    late, aligned = summary.get("lateness_ms") or {}, summary.get("alignment") or {}
    segments = ", ".join(
        f"{part['name']} {part['end_s'] - part['start_s']:g} s" for part in planned.get("segments") or []
    )
    torque_time = planned.get("torque_time_nms")
    dose = f"{number(summary.get('charge_uc'), 0)} µC a phase over the test"
    if torque_time is not None:
        dose += f", {number(torque_time, 0)} N·m·s planned"
    return [
        f"test           {test['id']}  participant {test['participant']}, {number(summary.get('duration_s'), 1)} s",
        f"segments       {segments}",
        f"dose           {dose}",
        f"torque         {summary.get('samples')} samples at {number(summary.get('sample_rate_hz'), 1)} Hz, "
        f"lost {summary.get('lost_samples')}, peak {number(summary.get('torque_peak_nm'))} N·m",
        f"pulses         {summary.get('pulses')}, dropped {summary.get('dropped_pulses')}; lateness median "
        f"{number(late.get('median'), 3)}, p99 {number(late.get('p99'), 3)}, max {number(late.get('max'), 3)} ms",
        f"clocks         aligned by {aligned.get('method')}, error {number(aligned.get('error_ms'), 4)} ms",
        *(f"in doubt       {words}" for words in summary.get("warnings") or []),
        *fit_lines(model),
        f"served         {number(summary.get('last_sample_to_model_s'), 2)} s from the last sample to the stored model",
    ]


def fit_lines(model: dict[str, Any]) -> list[str]:
    """The model's part of the report."""
    from api.cli.terminal import model_report

    return model_report(model)
