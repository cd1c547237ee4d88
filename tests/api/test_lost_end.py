"""A test whose end is lost on the way to the service lets the rig go all the same."""

from __future__ import annotations

import time
from typing import Any

import httpx
import pytest

from api.sessions.rig_client import RigClient
from tests.api.conftest import Service, let_go, run_test


def test_an_end_that_was_never_told_is_found_by_asking(
    client: httpx.Client, service: Service, participant: str
) -> None:
    service.rig.loses_ends = True
    ended = run_test(client, participant)
    assert ended["recording_id"] == f"R-{ended['id']}" and ended["state"] == "completed" and ended["model_id"]
    service.rig.loses_ends = False
    assert let_go(client)
    assert run_test(client, participant)["state"] == "completed"
    ends = [e for e in client.get("/v1/audit").json()["entries"] if e["action"].startswith("test ")]
    assert len(ends) == 2, "each end is written down once"


def test_a_failing_listener_costs_nobody_else_the_news(
    client: httpx.Client, service: Service, participant: str
) -> None:
    """The first events come while the start is under way: a link that broke there made the start a 503."""
    rig, told = service.app.state.context.rig, []

    def always(event: Any) -> None:
        told.append(type(event).__name__)
        raise RuntimeError("unexpected")

    links: list[bool] = []
    rig.listeners.insert(0, always)
    rig.link_listeners.append(links.append)
    assert run_test(client, participant)["state"] == "completed"
    assert {"StateEvent", "LiveEvent", "FinishedEvent"} <= set(told)
    assert links == [] and client.get("/v1/rig").json()["connected"]


def test_a_message_that_cannot_be_taken_costs_one_connection_at_most(
    client: httpx.Client, service: Service, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unexpected error outside a listener; a service that never connects again hears of no test's end."""
    rig, failures = service.app.state.context.rig, []

    def once(message: dict[str, Any], subscription_id: int) -> None:
        if not failures:
            failures.append(message)
            raise RuntimeError("unexpected")
        RigClient._take(rig, message, subscription_id)

    monkeypatch.setattr(rig, "_take", once)
    end = time.monotonic() + 20
    while not (failures and rig.connected):  # its next poll is the message; then it connects anew
        assert time.monotonic() < end
        time.sleep(0.05)
    assert run_test(client, participant)["state"] == "completed"


def test_a_failure_in_a_poll_does_not_end_the_polling(client: httpx.Client, service: Service) -> None:
    rig, calls = service.app.state.context.rig, []

    def always(_status: Any) -> None:
        calls.append(time.monotonic())
        raise RuntimeError("unexpected")

    rig.poll_listeners.insert(0, always)
    end = time.monotonic() + 20
    while len(calls) < 2:
        assert time.monotonic() < end, calls
        time.sleep(0.05)
    assert client.get("/v1/rig").json()["connected"]
