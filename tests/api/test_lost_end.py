"""A test whose end is lost on the way to the service lets the rig go all the same."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.api import fake_rig
from tests.api.conftest import Service, run_test


def test_an_end_that_was_never_told_is_found_by_asking(
    client: httpx.Client, service: Service, participant: str
) -> None:
    service.rig.loses_ends = True
    ended = run_test(client, participant)
    assert ended["recording_id"] == f"R-{ended['id']}" and ended["state"] == "completed" and ended["model_id"]
    service.rig.loses_ends = False
    assert client.get("/v1/rig").json()["holder"] is None
    assert run_test(client, participant)["state"] == "completed"
    ends = [e for e in client.get("/v1/audit").json()["entries"] if e["action"].startswith("test ")]
    assert len(ends) == 2, "each end is written down once"


def test_a_failure_in_the_link_does_not_end_it(client: httpx.Client, service: Service, participant: str) -> None:
    """Events are taken by listeners; an unexpected error in one of them must cost one connection at most."""
    failures = []

    def once(_event: Any) -> None:
        if not failures:
            failures.append("first event")
            raise RuntimeError("unexpected")

    service.app.state.context.rig.listeners.insert(0, once)
    assert run_test(client, participant)["state"] == "completed"
    assert failures and client.get("/v1/rig").json()["connected"]


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


def test_a_fake_rig_that_fails_at_a_tests_end_says_so(
    client: httpx.Client, participant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What held the rig for ever in a loaded run of the page's tests: the player's own failure was told to nobody."""

    def broken(folder: Path, *_: Any) -> Any:
        raise AttributeError("partially initialized module")

    monkeypatch.setattr(fake_rig, "write_recording", broken)
    ended = run_test(client, participant)
    assert ended["state"] == "fault" and "partially initialized" in ended["reason"]
    assert client.get("/v1/rig").json()["holder"] is None
