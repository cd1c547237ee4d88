"""A key at the terminal stops a running test, in `stimrig test` and in `stimrig serve`."""

from __future__ import annotations

import contextlib
import functools
import os
import pty
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import httpx
import pytest

from stimrig.api.cli import main, stop_key
from stimrig.api.cli.commands import serve
from stimrig.api.cli.commands import test as test_verb
from stimrig.api.cli.stop_key import StopKey, at_rig, at_service
from tests.api.conftest import TOKEN, Service, soon, wait_done


class Terminal:
    """A terminal: the keyboard's end, the program's end, and what was said on it."""

    def __init__(self) -> None:
        self.keyboard, self.program = pty.openpty()
        self.words: list[str] = []

    def watch(self, stop: Any) -> StopKey:
        return StopKey(stop, self.words.append, self.program)

    def press(self, key: bytes = b"x") -> str:
        """What is said of a key; nothing else is."""
        os.write(self.keyboard, key)
        (said,) = soon(lambda: self.words, 15)
        self.words.clear()
        return said


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    for descriptor in (made.keyboard, made.program):
        with contextlib.suppress(OSError):
            os.close(descriptor)


def started(client: httpx.Client, service: Service, participant: str) -> str:
    service.rig.speed = 1.0
    return client.post("/v1/tests", json={"participant": participant}).json()["id"]


@pytest.mark.parametrize("way", ["rig", "service"])
def test_any_key_stops_a_running_test(
    client: httpx.Client, service: Service, participant: str, terminal: Terminal, way: str
) -> None:
    before = termios.tcgetattr(terminal.program)
    stop = at_rig(service.rig.path) if way == "rig" else at_service(service.url, TOKEN)
    with terminal.watch(stop) as key:
        assert key.watched
        test_id = started(client, service, participant)
        assert terminal.press() == stop_key.CONFIRMED
        ended = wait_done(client, test_id)
    assert ended["state"] == "stopped" and service.rig.stopped_by == (stop_key.BY if way == "rig" else "administrator")
    assert termios.tcgetattr(terminal.program) == before, "the terminal is as it was"


def test_a_key_while_nothing_runs_does_not_latch(service: Service, terminal: Terminal) -> None:
    with terminal.watch(at_rig(service.rig.path)):
        assert terminal.press(b"\n") == stop_key.NOTHING
        with service.client() as http:
            assert http.get("/v1/rig").json()["state"] == "ready"
            http.post("/v1/stop")
        assert terminal.press(b" ") == stop_key.NOTHING


def test_what_is_not_confirmed_says_what_to_do(
    client: httpx.Client, service: Service, participant: str, terminal: Terminal, tmp_path: Path
) -> None:
    service.rig.confirms_stop = False
    with terminal.watch(at_rig(service.rig.path)):
        started(client, service, participant)
        said = terminal.press()
        assert "emergency switch" in said and "No ack." in said
    with terminal.watch(at_rig(tmp_path / "none.sock")):
        said = terminal.press()
        assert "emergency switch" in said and "cannot be reached" in said
    with terminal.watch(lambda: [][0]):
        said = terminal.press()
        assert "emergency switch" in said and "IndexError" in said


def test_without_a_terminal_nothing_listens_and_one_that_closes_ends_it(tmp_path: Path, terminal: Terminal) -> None:
    reading, writing = os.pipe()
    with StopKey(lambda: "never", print, reading) as key, (tmp_path / "file").open("w") as file:
        os.write(writing, b"x")
        with StopKey(lambda: "never", print, file.fileno()) as other:
            assert not key.watched and not other.watched
    assert os.read(reading, 1) == b"x", "what is not a terminal is not read"
    for descriptor in (reading, writing):
        os.close(descriptor)
    with StopKey(lambda: "never", print, terminal.program) as key:
        os.close(terminal.keyboard)
        assert key._thread is not None
        key._thread.join(5)
        assert not key._thread.is_alive()


@pytest.mark.parametrize("plays", [True, False])
def test_a_key_stops_stimrig_test_once_it_plays_and_keeps_it_from_beginning_before(
    service: Service, terminal: Terminal, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    plays: bool,
) -> None:  # fmt: skip
    service.rig.speed = 1.0
    monkeypatch.setenv("STIMRIG_TOKEN", TOKEN)
    monkeypatch.setattr(stop_key, "standard_input", lambda: terminal.program)
    real, pressed = test_verb.run_test, []

    def look() -> list[str]:
        if service.rig.state == "running" and not pressed:
            pressed.append(os.write(terminal.keyboard, b"q"))
        return []

    def run_test(client: Any, participant: str, events: Any, over: Any, **more: Any) -> dict[str, Any]:
        if not plays:
            pressed.append(os.write(terminal.keyboard, b"q"))
            soon(lambda: service.rig.state == "latched", 20)
        return real(client, participant, look if plays else events, over, **more)

    monkeypatch.setattr(test_verb, "run_test", run_test)
    assert main.run(["test", "--url", service.url, "--participant", "K1"]) == 1
    said = capsys.readouterr().err
    assert "any key stops the test" in said and "any key" not in said.splitlines()[-1]
    assert "ended as stopped" in said if plays else stop_key.CONFIRMED in said
    assert service.rig.starts == int(plays)


@pytest.mark.parametrize("body", [
    "null", "[]", "{}", "<p>", '{"state": "ready", "connected": true, "age_s": 9.0, "holder": null}',
    '{"state": "ready", "connected": false, "age_s": 0.1, "holder": null}',
    '{"state": "ready", "connected": true, "age_s": 0.1, "holder": {"test_id": "T1"}}',
])  # fmt: skip
def test_nothing_that_a_service_says_of_its_rig_keeps_a_key_from_stopping(monkeypatch: pytest.MonkeyPatch, body: str):
    posted: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        posted.extend([request.url.path] if request.method == "POST" else [])
        return httpx.Response(200, text=body)

    made = functools.partial(httpx.Client, transport=httpx.MockTransport(answer))
    monkeypatch.setattr(stop_key.httpx, "Client", made)
    assert at_service("http://rig.test", TOKEN)() == stop_key.CONFIRMED
    assert posted == ["/v1/stop"]


def test_a_key_stops_in_stimrig_serve(
    client: httpx.Client, service: Service, participant: str, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_id, looks = started(client, service, participant), []

    def watch() -> list[str]:
        looks.append(os.write(terminal.keyboard, b"s") if not looks else 0)
        if service.rig.state == "latched":
            raise KeyboardInterrupt
        return []

    given = MagicMock(url=service.url, socket=service.rig.path, watch=watch, emulator=None)
    given.settings, given.api.ready = service.context.settings, {"drawn_token": ""}
    given.__exit__.return_value = None
    monkeypatch.setattr(serve, "Services", lambda *_: given)
    monkeypatch.setattr(stop_key, "standard_input", lambda: terminal.program)
    serve.serve()
    assert wait_done(client, test_id)["state"] == "stopped" and service.rig.stopped_by == stop_key.BY
