"""Traces: one tree from the request to the rig's pulse, nothing of a person in it, and nobody waits for a collector."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api import traces
from stimrig.api.errors import SettingsError
from stimrig.api.operation import telemetry
from stimrig.api.operation.telemetry import Telemetry, endpoint_of
from stimrig.api.settings import Settings
from stimrig.api.traces import Span, Step, Tracer, allowed, current_span, span_of
from tests.api.conftest import TOKEN, Service, run_test
from tests.harness.collector import Collector, collector

KNOWN = Span("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("stimrig.test.id", "P017"), ("stimrig.test.id", "T20260101T080000-abcdef P017"), ("participant", "P017"),
        ("stimrig.test.kind", "anna-schmidt"), ("http.route", "/v1/participants/P017?token=x"), ("http.route", "P017"),
        ("stimrig.pulses", "P017"), ("stimrig.test.outcome", "the participant P017 left"), ("error.type", "P017 left"),
        ("error.type", None), ("stimrig.stop.confirmed", [True]), ("http.request.method", "GET P017"),
    ],
)  # fmt: skip
def test_what_is_not_on_the_list_or_of_another_form_does_not_leave(name: str, value: object) -> None:
    assert allowed({name: value, "stimrig.pulses": 3} if name != "stimrig.pulses" else {name: value}) in (
        {"stimrig.pulses": 3}, {},
    )  # fmt: skip


def test_every_kind_of_test_that_the_service_plays_may_be_told(service: Service) -> None:
    names = {name for kind in service.context.runner.kinds.all for name in kind.names} | {"pre-session"}
    assert {name for name in names if not traces.SAYS["stimrig.test.kind"](name)} == set()


def test_steps_stand_below_one_another_and_an_error_is_told_by_its_code_alone() -> None:
    told: list[Step] = []
    tracer = Tracer(told.append)
    with pytest.raises(SettingsError), tracer.step("button", root=True):
        with tracer.step("rig start") as says:
            says["stimrig.pulses"] = 3
            assert span_of(tracer.traceparent) == current_span.get()
        raise SettingsError("P017 is not here")
    assert current_span.get() is None and tracer.traceparent is None
    below, root = told
    assert below.parent == root.span and root.parent is None and below.span.trace_id == root.span.trace_id
    assert root.says == {"error.type": "internal"} and below.says == {"stimrig.pulses": 3}
    assert root.start_unix_s <= below.start_unix_s <= below.end_unix_s <= root.end_unix_s


def test_telemetry_that_fails_is_no_reason_to_fail(caplog: pytest.LogCaptureFixture) -> None:
    with Tracer(lambda _step: 1 / 0).step("button", root=True):  # type: ignore[arg-type,return-value]
        pass
    assert "could not be told: ZeroDivisionError" in caplog.text


@pytest.mark.parametrize("given", [None, "", 3, "00-x-y-01", KNOWN.traceparent + "0", f"01{KNOWN.traceparent[2:]}"])
def test_what_is_no_context_is_none(given: object) -> None:
    assert span_of(given) is None and span_of(KNOWN.traceparent) == KNOWN


@pytest.mark.parametrize(
    ("setting", "environment", "found"),
    [
        (None, {}, None),
        ("http://127.0.0.1:4318", {}, "http://127.0.0.1:4318/v1/traces"),
        ("https://collector.example.org/otlp/v1/traces", {}, "https://collector.example.org/otlp/v1/traces"),
        (None, {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://localhost:4318/"}, "http://localhost:4318/v1/traces"),
        (None, {"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": "http://localhost:1/x"}, "http://localhost:1/x"),
    ],
)
def test_where_traces_go(setting: str | None, environment: dict[str, str], found: str | None, tmp_path: Path) -> None:
    assert endpoint_of(Settings(data_dir=tmp_path, otlp_endpoint=setting), environment) == found


@pytest.mark.parametrize("setting", ["collector", "ftp://127.0.0.1/x", "http://collector.example.org:4318", "http://"])
def test_an_address_that_does_not_hold_is_told_in_one_line(setting: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="STIMRIG_OTLP_ENDPOINT") as told:
        endpoint_of(Settings(data_dir=tmp_path, otlp_endpoint=setting), {})
    assert "\n" not in str(told.value)


def test_without_the_package_it_is_told_which_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(SettingsError, match=r"stimrig\[telemetry\]"):
        Telemetry(Settings(data_dir=tmp_path, otlp_endpoint="http://127.0.0.1:4318"))


def test_who_names_no_collector_loads_nothing_of_it() -> None:
    code = (
        "import sys, stimrig.api.web.app; from stimrig.api.operation.telemetry import Telemetry; "
        "from stimrig.api.settings import Settings; Telemetry(Settings()).close(); "
        "print([name for name in sys.modules if name.startswith(('opentelemetry.sdk', 'opentelemetry.exporter'))])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    """A collector that services which are made from here on tell."""
    with collector() as kept:
        monkeypatch.setenv("STIMRIG_OTLP_ENDPOINT", kept.url)
        monkeypatch.setenv("OTEL_RESOURCE_ATTRIBUTES", "host.name=secret-host")
        yield kept


def flushed(service: Service, kept: Collector) -> list[Any]:
    """All steps so far."""
    service.context.tracer._provider.force_flush()
    return kept.spans()


def test_a_test_and_a_stop_over_the_api_tell_nothing_of_anybody(taken: Collector, service: Service) -> None:
    with service.client() as client:
        assert client.post("/v1/participants", json={"code": "P017"}).status_code == 201
        document = run_test(client, "P017")
        client.post("/v1/stop", json={"reason": "Anna Schmidt wanted it"})
        client.post("/v1/participants/P017/notes", json={"kind": "other", "text": "Anna Schmidt coughs"})
        client.post("/v1/nowhere/P017", headers={"traceparent": KNOWN.traceparent, "baggage": "who=anna"})
        spans = flushed(service, taken)
    names = {span.name for span in spans}
    assert {"POST /v1/participants", "POST /v1/tests", "rig preview", "rig start", "rig stop", "POST /v1/stop"} <= names
    assert not any(span.trace_id.hex() == KNOWN.trace_id for span in spans)
    for body in [*taken.bodies, *(head.encode() for head in taken.heads)]:
        for word in (b"P017", b"Anna", b"anna", b"coughs", TOKEN.encode(), b"administrator", b"secret-host"):
            assert word not in body, word
    assert document["id"].encode() in b"".join(taken.bodies), "a test's id is told"


def test_no_request_waits_for_a_collector_that_says_nothing(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds each request until the end: were anything to wait for it, this would never come to its end."""
    with collector(answers=False) as kept:
        monkeypatch.setattr(telemetry, "LONGEST_QUEUE", 8)
        deaf = telemetry.provider_to(f"{kept.url}/v1/traces")
        send = telemetry.Sender(deaf)
        monkeypatch.setattr(service.context.tracer, "_send", send)
        for _ in range(100):
            send(Step("step", KNOWN.below(), KNOWN, 0.0, 1.0))
        assert run_test(client, participant)["state"] == "completed"
        assert client.post("/v1/stop").json()["stopped"]
        assert not kept.hold.is_set()
        kept.hold.set()
    deaf.shutdown()


def test_nor_for_one_that_is_not_there(
    service: Service, client: httpx.Client, participant: str, tmp_path: Path
) -> None:
    gone = Telemetry(Settings(data_dir=tmp_path, otlp_endpoint="http://127.0.0.1:9"))
    service.context.tracer._send = gone._send
    assert run_test(client, participant)["state"] == "completed"
    gone.close()


def test_log_lines_of_a_request_carry_the_ids_of_its_trace(taken: Collector, service: Service, capfd: Any) -> None:
    import logging

    from stimrig.api.logs import JsonLines

    record = logging.LogRecord("stimrig", logging.INFO, "", 0, "words", (), None)
    with service.context.tracer.step("button", root=True):
        line = json.loads(JsonLines("service").format(record))
        span = current_span.get()
    assert span is not None and (line["trace_id"], line["span_id"]) == (span.trace_id, span.span_id)
    assert "trace_id" not in json.loads(JsonLines("service").format(record))
