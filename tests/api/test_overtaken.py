"""What is asked for and then overtaken, by a stop, by other limits, by time, is not played once the way is free."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from api.sessions import runner
from tests.api.conftest import Service


class Held:
    """A start that waits in the service, after all that was read for it and before its command to the rig."""

    def __init__(self, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.free = threading.Event(), threading.Event()
        target = service.app.state.context.runner
        write = target._write_intent

        def slowly(*arguments: Any) -> Any:
            row = write(*arguments)
            self.reached.set()
            assert self.free.wait(20)
            return row

        monkeypatch.setattr(target, "_write_intent", slowly)

    def start(self, pool: ThreadPoolExecutor, client: httpx.Client, participant: str) -> Future[httpx.Response]:
        asked = pool.submit(client.post, "/v1/tests", json={"participant": participant}, timeout=30)
        assert self.reached.wait(20)
        return asked


@pytest.fixture
def held(service: Service, monkeypatch: pytest.MonkeyPatch) -> Iterator[Held]:
    held = Held(service, monkeypatch)
    yield held
    held.free.set()


def test_a_start_that_a_stop_has_overtaken_is_not_played_after_a_rearm(
    client: httpx.Client, service: Service, participant: str, held: Held
) -> None:
    with ThreadPoolExecutor(1) as pool:
        asked = held.start(pool, client, participant)
        assert client.post("/v1/stop", json={"reason": "now"}).status_code == 200
        assert client.post("/v1/rearm").status_code == 200
        held.free.set()
        answer = asked.result()
    assert answer.status_code == 409 and "cancelled by a stop" in answer.json()["title"]
    assert service.rig.starts == 0
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202


def test_limits_lowered_while_a_start_is_on_its_way_are_not_passed_by(
    client: httpx.Client, service: Service, participant: str, held: Held
) -> None:
    with ThreadPoolExecutor(1) as pool:
        asked = held.start(pool, client, participant)
        answer = client.put(f"/v1/participants/{participant}/profile", json={"current_ma": 5})
        assert answer.status_code == 200
        held.free.set()
        assert asked.result().status_code == 409
    assert service.rig.starts == 0


def test_a_start_that_took_too_long_is_not_played_any_more(
    client: httpx.Client, service: Service, participant: str, held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "START_S", 0.0)
    with ThreadPoolExecutor(1) as pool:
        asked = held.start(pool, client, participant)
        held.free.set()
        answer = asked.result()
    assert answer.status_code == 503 and "took too long" in answer.json()["title"]
    assert service.rig.starts == 0
