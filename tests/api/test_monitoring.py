"""The figures of `/metrics` tell of stops and the rig, and nothing of anybody."""

from __future__ import annotations

from pathlib import Path

import httpx
from prometheus_client.parser import text_string_to_metric_families

from tests.api.conftest import Service, run_test


def exported(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    """Samples by name."""
    found: dict[str, list[tuple[dict[str, str], float]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def test_every_figure_stands_in_the_docs_and_tells_nothing_of_anybody(
    service: Service, client: httpx.Client, participant: str
) -> None:
    service.rig_thread.rig.more_summary = {"ack_delay_ms": {"median": 1.1, "p99": 1.9, "max": 2.4}}
    run_test(client, participant)
    client.post("/v1/stop", json={"reason": "typed by a person"})
    text = client.get("/metrics", headers={"Authorization": ""}).text
    there = exported(text)
    assert there["stimrig_stops_total"] == [
        ({"outcome": "confirmed"}, 1.0), ({"outcome": "not-confirmed"}, 0.0), ({"outcome": "failed"}, 0.0)
    ]  # fmt: skip
    assert there["stimrig_stop_confirmation_seconds_count"] == [({}, 1.0)]
    assert [labels["state"] for labels, value in there["stimrig_rig_state"] if value] == ["latched"]
    assert {labels["quantile"] for labels, _ in there["stimrig_pulse_lateness_seconds"]} == {"0.5", "0.99", "1"}
    assert participant not in text and "typed by" not in text
    assert participant not in client.get("/health", headers={"Authorization": ""}).text
    labels = {key for samples in there.values() for one, _ in samples for key in one}
    assert labels == {"state", "outcome", "quantile", "version", "le"}
    page = (Path(__file__).parents[2] / "docs" / "operation.md").read_text("utf-8")
    families = [one.name for one in text_string_to_metric_families(text)]
    assert [name for name in families if f"`{name}" not in page] == []
