"""On the emulated rig as processes: a test's trace is one tree to its pulse, and log lines are as the docs say."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.cli.launcher import Services
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings
from tests.api.conftest import TOKEN, wait_done
from tests.harness.collector import Collector, collector
from tests.harness.looks_first import LooksFirst

pytestmark = pytest.mark.wire
DOCS = Path(__file__).parents[2] / "docs" / "operation.md"
PERSON, CODE, TYPED = "Anna-Schmidt", "P-SECRET-7", "she-felt-unwell"
ALWAYS = {"time", "level", "process", "logger", "message"}
TREE = {
    "POST /v1/tests": None,
    "rig preview": "POST /v1/tests",
    "intent is written down": "POST /v1/tests",
    "rig start": "POST /v1/tests",
    "rig: test": "rig start",
    "rig: plan check": "rig: test",
    "rig: journal, sensors, gate": "rig: test",
    "rig: first pulse to its acknowledgement": "rig: test",
    "rig: stimulation": "rig: test",
    "rig: confirmed stop, sealing": "rig: test",
}
STOP = {"POST /v1/stop": None, "rig stop": "POST /v1/stop", "rig: stop to its evidence": "rig stop"}


def documented() -> set[str]:
    """The fields of log lines."""
    rows = DOCS.read_text("utf-8").partition("| field | is |")[2].partition("\n\n")[0].splitlines()[2:]
    return {name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])}


def lines(folder: Path) -> Iterator[tuple[str, str]]:
    """Every line of every log, with its file."""
    for path in sorted(folder.glob("*.log")):
        for line in path.read_text("utf-8").splitlines():
            yield path.name, line


def tree(spans: list[Any]) -> dict[str, str | None]:
    """Each step's name, and that of the one above."""
    names = {span.span_id: span.name for span in spans}
    return {span.name: names[span.parent_span_id] if span.parent_span_id else None for span in spans}


def traces(kept: Collector) -> dict[str, list[Any]]:
    """The steps of each trace, by the name of its first one."""
    by_id: dict[bytes, list[Any]] = {}
    for span in kept.spans():
        by_id.setdefault(span.trace_id, []).append(span)
    roots = ((next(span.name for span in spans if not span.parent_span_id), spans) for spans in by_id.values())
    found: dict[str, list[Any]] = {}
    for name, spans in roots:
        found.setdefault(name, spans)
    return found


def test_a_traced_test_and_stop_are_trees_and_no_log_names_anybody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}}
    widths = {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": [150.0] * 200, "jumps": True}}
    asked = {"participant": CODE, "kind": "sequence", "segments": [rest, widths, rest]}
    with collector() as kept:
        monkeypatch.setenv("STIMRIG_OTLP_ENDPOINT", kept.url)
        settings = Settings(data_dir=tmp_path, port=0)
        with Services(settings, ["--speed", "4"], TOKEN) as services, Client(services.url, TOKEN) as admin:
            user = {"name": PERSON, "password": "a long enough password"}
            admin.http.post("/v1/users", json=user).raise_for_status()
            token = admin.issue_token(PERSON, ["run-test", "rearm", "read-live"])
            admin.make_participant(CODE)
            with httpx.Client(base_url=services.url, auth=LooksFirst(token), timeout=60) as person:
                first = person.post("/v1/tests", json=asked)
                assert first.status_code == 202, first.text
                played = _ended(admin, first)
                assert played["state"] == "completed", played
                second = person.post("/v1/tests", json=asked)
                assert second.status_code == 202, second.text
                person.post("/v1/stop", json={"reason": TYPED}).raise_for_status()
                _ended(admin, second)
                person.post("/v1/rearm").raise_for_status()
    by_root = traces(kept)
    told = tree(by_root["POST /v1/tests"])
    assert told == TREE
    assert tree(by_root["POST /v1/stop"]) == STOP
    for span in kept.spans():
        assert span.start_time_unix_nano <= span.end_time_unix_nano, span.name
    secrets = (CODE, PERSON, TYPED, TOKEN, token, "a long enough password")
    for body in kept.bodies:
        assert not [word for word in secrets if word.encode() in body]
    all_as_documented(tmp_path / "logs", first.json()["id"], secrets)


def _ended(client: Client, answer: Any) -> dict[str, Any]:
    """The test once it is closed."""
    return wait_done(client.http, answer.json()["id"], 120)


def all_as_documented(logs: Path, test_id: str, secrets: tuple[str, ...]) -> None:
    """Every line is an object with the fields of the docs, and holds none of the secrets."""
    fields, processes, of_test = documented(), set(), set()
    assert fields > ALWAYS
    found = list(lines(logs))
    assert {name for name, _ in found} >= {"api.log", "rig.log"}
    for name, line in found:
        content = json.loads(line)
        assert set(content) >= ALWAYS and set(content) <= fields, (name, line)
        assert not [word for word in secrets if word in line], line
        processes.add(content["process"])
        of_test |= {content["process"]} if content.get("test_id") == test_id else set()
    assert processes >= {"service", "rig"} and of_test >= {"service", "rig"}
    assert any("uvicorn" in line for _, line in found), "uvicorn's own lines, too"
