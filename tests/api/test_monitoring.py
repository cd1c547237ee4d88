"""Dashboard and alerts use figures that the service has; the figures tell of stops, backups and the clock."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from stimrig.api.clock import Clock
from stimrig.api.operation import clock_watch, state
from stimrig.api.operation.clock_watch import ClockWatch, Synchronised
from stimrig.api.operation.counted import Counted
from tests.api.conftest import Service, run_test

MONITORING = Path(__file__).parents[2] / "deploy" / "monitoring"
NAME = re.compile(r"\bstimrig_\w+")


def used() -> dict[str, str]:
    """Figures that dashboard and alerts name, each with its place."""
    panels = json.loads((MONITORING / "dashboard.json").read_text("utf-8"))["panels"]
    found = {name: panel["title"] for panel in panels for one in panel["targets"] for name in NAME.findall(one["expr"])}
    return found | {name: rule["alert"] for rule in rules() for name in NAME.findall(str(rule["expr"]))}


def rules() -> list[dict[str, Any]]:
    content = yaml.safe_load((MONITORING / "alerts.yaml").read_text("utf-8"))
    return [rule for group in content["groups"] for rule in group["rules"]]


def exported(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    """Samples by name."""
    found: dict[str, list[tuple[dict[str, str], float]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def test_every_figure_that_is_used_is_there_and_tells_nothing_of_anybody(
    service: Service, client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.rig_thread.rig.more_summary = {"ack_delay_ms": {"median": 1.1, "p99": 1.9, "max": 2.4}}
    run_test(client, participant)
    client.post("/v1/stop", json={"reason": "typed by a person"})
    settings = service.context.settings
    state.note(settings.data_dir, created_utc="2026-11-01T00:00:00Z", verified_utc="2026-11-02T00:00:00Z")
    text = client.get("/metrics", headers={"Authorization": ""}).text
    there = exported(text)
    assert {name: place for name, place in used().items() if name not in there} == {}
    assert "stimrig_gone" not in there, "one that is not exported would be noticed"
    assert there["stimrig_stops_total"] == [
        ({"outcome": "confirmed"}, 1.0), ({"outcome": "not-confirmed"}, 0.0), ({"outcome": "failed"}, 0.0)
    ]  # fmt: skip
    assert there["stimrig_stop_confirmation_seconds_count"] == [({}, 1.0)]
    assert [labels["state"] for labels, value in there["stimrig_rig_state"] if value] == ["latched"]
    assert {labels["quantile"] for labels, _ in there["stimrig_pulse_lateness_seconds"]} == {"0.5", "0.99", "1"}
    assert there["stimrig_rig_check_due"] == [({}, 0.0)]
    assert there["stimrig_backup_verified_timestamp_seconds"] == [({}, 1793577600.0)]
    assert participant not in text and "typed by" not in text
    labels = {key for samples in there.values() for one, _ in samples for key in one}
    assert labels == {"state", "outcome", "quantile", "version", "le"}


def test_rules_parse_and_each_has_what_to_do_in_the_docs() -> None:
    page = (Path(__file__).parents[2] / "docs" / "operation.md").read_text("utf-8")
    for rule in rules():
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}, rule
        assert rule["labels"]["severity"] in ("page", "warn") and rule["annotations"]["summary"].endswith(".")
        assert f"`{rule['alert']}`" in page, rule["alert"]
        assert rule["expr"].count("(") == rule["expr"].count(")")
    if (tool := shutil.which("promtool")) is not None:
        subprocess.run([tool, "check", "rules", MONITORING / "alerts.yaml"], check=True)


def test_each_figure_stands_in_the_docs(client: httpx.Client) -> None:
    page = (Path(__file__).parents[2] / "docs" / "operation.md").read_text("utf-8")
    families = [one.name for one in text_string_to_metric_families(client.get("/metrics").text)]
    assert [name for name in families if f"`{name}" not in page] == []


class Moved(Clock):
    """A clock whose two hands are set by hand."""

    def __init__(self) -> None:
        self.utc_s, self.mono_s = 1.8e9, 100.0

    def unix_s(self) -> float:
        return self.utc_s

    def monotonic_s(self) -> float:
        return self.mono_s

    def go_on(self, by_s: float, jump_s: float = 0.0) -> None:
        self.utc_s, self.mono_s = self.utc_s + by_s + jump_s, self.mono_s + by_s


def test_a_jump_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    clock, asked = Moved(), []
    watch = ClockWatch(clock, lambda: asked.append(1) or Synchronised(True, 0.001))
    for _ in range(13):
        watch.look()
        clock.go_on(5.0, 1.9)  # each below what counts
    assert watch.jumps == 0 and len(asked) == 2, "every 5 s a look, every 60 s a question"
    clock.go_on(5.0, -3600.0)
    watch.look()
    noticed_utc = clock.utc()
    clock.go_on(5.0)
    watch.look()
    assert watch.jumps == 1 and watch.last_jump_s == pytest.approx(-3598.1)
    assert [record.message for record in caplog.records if "jumped" in record.message] == [
        "the machine's clock jumped by -3598.1 s; recordings and entries carry its date"
    ]
    assert watch.as_dict()["synchronised"] is True and watch.as_dict()["last_jump_utc"] == noticed_utc != clock.utc()


def test_health_tells_of_the_clock(client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    told = client.get("/health").json()["clock"]
    assert told["jumps"] == 0 and told["last_jump_s"] is None
    monkeypatch.setattr(service.context.clock_watch, "synchronised", Synchronised(False))
    assert client.get("/health").json()["clock"]["synchronised"] is False


@pytest.mark.parametrize(("says", "known"), [("yes", True), ("no", False), ("", None), ("n/a", None)])
def test_who_sets_the_clock_is_asked_of_systemd_where_the_kernel_may_not_be(
    says: str, known: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "timedatectl"
    tool.write_text(f"#!/bin/sh\necho {says}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    monkeypatch.setattr(clock_watch, "ask_kernel", lambda: None)
    assert clock_watch.ask_machine() == Synchronised(known)


def test_the_kernel_may_be_asked_and_nothing_is_changed_by_it() -> None:
    found = clock_watch.ask_kernel()
    assert found is None or found.by_service in (True, False)
    if found is not None and found.by_service:
        assert found.error_s is not None and 0 <= found.error_s < 100


def test_a_stop_that_was_not_answered_has_no_time() -> None:
    counted = Counted()
    counted.stopped("failed", 8.0)
    values = {sample.name: sample.value for family in counted.collect() for sample in family.samples}
    assert values["stimrig_stop_confirmation_seconds_count"] == 0
