"""Who has the stop button in view, or a key of the terminal, may stop; only a person lets the rig work again."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import pty
import re
import socket
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, Mock
from urllib.parse import urlsplit

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from stimrig.api.cli import main, stop_key
from stimrig.api.cli.commands import serve
from stimrig.api.cli.commands import test as test_verb
from stimrig.api.cli.stop_key import StopKey, at_rig, at_service
from stimrig.api.clock import Clock
from stimrig.api.people.auth import Scope
from stimrig.api.sessions.stops import RIGHT_S, StopRights
from tests.api import forms
from tests.api.conftest import HTML, PASSWORD, TOKEN, Service, SetClock, person, soon, wait_done
from tests.api.test_people import standing_still

CONFIRMED = "The rig confirms that stimulation is off"


def viewer(service: Service) -> httpx.Client:
    """A browser in which a clinician has signed in and looks at pages."""
    browser = person(service)
    browser.headers.update(HTML)
    return browser


def cookie_name(service: Service) -> str:
    return service.context.auth.cookie_name


def right_on(page: str) -> str:
    (form,) = re.findall(r'<form method="post" action="/v1/stop".*?</form>', page, re.S)
    return re.findall(r'name="right" value="([^"]+)"', form)[0]


def running(service: Service, participant: str) -> str:
    service.rig.speed = 0.2  # two minutes: the stop ends it, however long the checks of passwords take
    with service.client() as client:
        return client.post("/v1/tests", json={"participant": participant}).json()["id"]


def press(service: Service, right: str, **more: Any) -> httpx.Response:
    """From a page that is open, by a browser that holds nothing else."""
    with service.client(token=None, headers=HTML, follow_redirects=True, **more) as browser:
        return browser.post("/v1/stop", data={"right": right, "reason": "stop pressed on the page"})


def stops_noted(client: httpx.Client) -> list[dict[str, Any]]:
    """The stops in the audit trail."""
    return [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "stop"]


def sign_out(browser: httpx.Client, _client: httpx.Client, _service: Service) -> None:
    assert browser.delete("/v1/sessions/current").status_code == 204


def run_out(_browser: httpx.Client, _client: httpx.Client, service: Service) -> None:
    service.sql("UPDATE page_sessions SET expires_unix_s = 0")


def new_password(_browser: httpx.Client, client: httpx.Client, _service: Service) -> None:
    assert client.put("/v1/users/Ada/password", json={"password": "another passphrase"}).status_code == 204


def remove(_browser: httpx.Client, client: httpx.Client, _service: Service) -> None:
    assert client.delete("/v1/users/Ada").status_code == 204


def locked_out(browser: httpx.Client, client: httpx.Client, service: Service) -> None:
    standing_still(service)
    sign_out(browser, client, service)
    for number in range(8):
        service.client(f"guess {number}").get("/v1/rig")
        browser.post("/v1/sessions", data={"name": "Ada", "password": "wrong"})
    assert browser.post("/v1/sessions", data={"name": "Ada", "password": PASSWORD}).status_code == 429


async def too_late(*_: object, **__: object) -> None:
    await asyncio.sleep(60)


async def gone(*_: object, **__: object) -> None:
    raise OperationalError("SELECT", {}, Exception("database is locked"))


@pytest.mark.parametrize("database", [too_late, gone])
def test_a_page_has_its_stop_button_while_the_database_does_not_answer(
    service: Service, client: httpx.Client, participant: str, database: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser, stranger = viewer(service), service.client(token=None, headers=HTML)
    browser.get("/")
    running(service, participant)
    monkeypatch.setattr(service.context.auth, "authenticate", database)
    shown = browser.get("/nowhere")
    assert shown.status_code == 404
    assert CONFIRMED in press(service, right_on(shown.text)).text
    assert 'action="/v1/stop"' not in stranger.get("/nowhere").text, "nobody who was not signed in before"


def test_no_page_gives_a_right_to_a_key_or_to_who_was_told_no_since(
    service: Service, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A right outlives what a key may do, and says more of a stop than a key is told."""
    key, removed = service.token("ctl", "read-live"), viewer(service)
    by_key = service.client(key, headers=HTML)
    as_cookie = service.client(token=None, headers=HTML, cookies={cookie_name(service): f"Bearer {key}"})
    assert by_key.get("/v1/rig", headers={"Accept": "application/json"}).status_code == 200
    assert removed.get("/").status_code == 200
    remove(removed, client, service)
    assert 'action="/v1/stop"' not in removed.get("/nowhere").text
    monkeypatch.setattr(service.context.auth, "authenticate", gone)
    for stranger in (by_key, as_cookie, removed):
        assert 'action="/v1/stop"' not in stranger.get("/nowhere").text


@pytest.mark.parametrize(
    ("end", "shown"),
    [(sign_out, "test"), (run_out, "home"), (new_password, "test"), (remove, "home"), (locked_out, "test")],
)
def test_a_page_that_shows_the_button_stops_whatever_became_of_its_session(
    service: Service, client: httpx.Client, participant: str, end: Callable[..., None], shown: str
) -> None:
    browser = viewer(service)
    home = browser.get("/").text
    test_id = running(service, participant)
    right = right_on(browser.get(f"/tests/{test_id}").text if shown == "test" else home)
    end(browser, client, service)
    answer = press(service, right, cookies=dict(browser.cookies))
    assert answer.status_code == 200 and CONFIRMED in answer.text
    assert service.rig.stopped_by == "Ada"
    (entry,) = soon(lambda: stops_noted(client))  # it may come after the answer
    assert (entry["who"], entry["subject"]) == ("Ada", test_id)


def test_a_stop_waits_for_no_database(service: Service, participant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    right = right_on(viewer(service).get("/").text)
    running(service, participant)
    store = service.context.store
    with store.write():  # another writer does not let go
        for read in ("get", "all"):
            broken = Mock(side_effect=OperationalError("SELECT", {}, Exception("disk I/O error")))
            monkeypatch.setattr(store, read, broken)
        answer = press(service, right, cookies={cookie_name(service): "old"})
        assert answer.status_code == 200 and CONFIRMED in answer.text
    monkeypatch.undo()


def test_the_answer_to_a_stop_that_is_not_confirmed_has_the_button_still(service: Service) -> None:
    browser = viewer(service)
    right = right_on(browser.get("/").text)
    service.rig.confirms_stop = False
    answer = press(service, right)
    assert answer.status_code == 503 and "emergency switch" in answer.text and "confirms" not in answer.text
    assert right_on(answer.text) == right
    service.rig.confirms_stop = True
    assert press(service, right_on(answer.text)).status_code == 200


def test_nobody_makes_a_right_and_a_restart_keeps_them(service: Service) -> None:
    real = service.context.stop_rights.give("Ada", None)
    assert StopRights(service.context.store.secret("stop-right"), Clock()).holder(real) == "Ada"
    words, _, mark = real.partition(".")
    other = StopRights(b"k" * 32, Clock()).give("Eve", None)
    for wrong in ("", "x", ".", "a.b", words, f"{words}.", f".{mark}", f"x{real}", f"{words}.{mark[:-4]}", other,
                  f"{other.partition('.')[0]}.{mark}", "A" * 5000, "ä.ö", real + "\N{SNOWMAN}"):  # fmt: skip
        answer = press(service, wrong)
        assert answer.status_code == 401, wrong
        assert "Nothing was stopped" in answer.text and "emergency switch" in answer.text
    assert service.rig.stopped_by is None
    with service.client(token=None) as http:
        assert http.post("/v1/stop", headers={"X-Stop-Right": other}).status_code == 401
        assert http.post("/v1/stop", headers={"X-Stop-Right": real}).json()["stopped"]


OPEN = ("/v1/stop", "/v1/sessions")


def test_a_right_opens_nothing_but_stop(service: Service) -> None:
    right = service.context.stop_rights.give("Ada", None)
    with service.client(token=None, headers={"X-Stop-Right": right}) as http:
        for path, methods in http.get("/openapi.json").json()["paths"].items():
            for method in methods:
                if path.startswith("/v1") and path not in OPEN:
                    answer = http.request(method.upper(), re.sub(r"\{\w+\}", "x", path), data={"right": right})
                    assert answer.status_code == 401, path


def test_a_right_lasts_a_day_or_as_long_as_its_test() -> None:
    clock = SetClock()
    rights = StopRights(b"k" * 32, clock)
    of_test, of_home = rights.give("Ada", "T1"), rights.give("Ada", None)
    clock.unix += RIGHT_S
    assert rights.holder(of_test) == rights.holder(of_home) == "Ada"
    clock.unix += 1
    assert rights.holder(of_test, {"T1"}) == "Ada"
    assert rights.holder(of_test, {"T2", None}) is None
    assert rights.holder(of_home, {"T1", None}) is None
    clock.unix -= 3 * RIGHT_S
    assert rights.holder(of_home) == "Ada", "a clock that is set back takes the right from nobody"


def test_a_right_token_stops_whatever_was_guessed_at_its_address(service: Service, client: httpx.Client) -> None:
    """The configured token, after a restart, while a client with an old token tries on at the same address."""
    for _ in range(20):
        service.context.auth.guesses.count(("token", "127.0.0.1"))
    assert client.get("/v1/rig").status_code == 429
    assert client.post("/v1/stop").status_code == 200
    assert client.get("/v1/rig").status_code == 429, "a stop opens nothing else"
    assert service.client("guess").post("/v1/stop").status_code == 429


@pytest.fixture
def slow_form(service: Service) -> Iterator[Callable[[str, str], socket.socket]]:
    """Sends a stop of which all has come but the last letter of its form: the caller sends it."""
    place = urlsplit(service.url)
    with socket.create_connection((place.hostname, place.port), timeout=20) as connection:

        def send(form: str, header: str) -> socket.socket:
            kind = f"Content-Type: application/x-www-form-urlencoded\r\nContent-Length: {len(form)}"
            connection.sendall(f"POST /v1/stop HTTP/1.1\r\nHost: x\r\n{header}\r\n{kind}\r\n\r\n{form[:-1]}".encode())
            return connection

        yield send


def test_a_right_in_a_form_that_comes_slowly_is_waited_for(
    service: Service, slow_form: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stimrig.api.web.guards.PATIENCE_S", 0.01)
    monkeypatch.setattr("stimrig.api.web.guards.LONGEST_PATIENCE_S", 60.0)
    right = service.context.stop_rights.give("Ada", None)
    connection = slow_form(f"right={right}", f"Cookie: {cookie_name(service)}=ended")
    time.sleep(0.2)
    connection.sendall(right[-1:].encode())
    assert connection.recv(12) == b"HTTP/1.1 200" and service.rig.stopped_by == "Ada"


def test_a_stop_that_is_allowed_anyway_waits_for_no_form(slow_form: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stimrig.api.web.guards.LONGEST_PATIENCE_S", 60.0)
    assert slow_form("reason=x", f"Authorization: Bearer {TOKEN}").recv(12) == b"HTTP/1.1 200"


# ---- re-arming ----------------------------------------------------------------------------------------------


def test_after_a_persons_stop_no_program_lets_the_rig_work_again(
    service: Service, client: httpx.Client, participant: str
) -> None:
    browser = viewer(service)
    assert press(service, right_on(browser.get("/").text)).status_code == 200
    most = [scope.value for scope in Scope if scope not in (Scope.REARM, Scope.ADMINISTER)]
    token = service.token("controller", *most)
    start = {"participant": participant}
    calibration = f"/v1/participants/{participant}/calibration"
    with service.client(token) as program, service.client(token=None, headers=HTML) as page:
        refused = program.post("/v1/rearm")
        assert refused.status_code == 403 and "rearm" in refused.json()["detail"]
        page.post("/v1/sessions", data={"token": token})
        head = {"X-CSRF-Token": forms.Page(page.get("/").text).meta, "Accept": "application/json"}
        assert page.post("/v1/rearm", headers=head).status_code == 403, "a token that signs in is no person"
        assert "I have checked" not in page.get("/").text
        assert program.post("/v1/tests", json=start).status_code == 409
        assert program.post(calibration).status_code == 409
        seen = {"If-Match": '"C1-1.0"'}
        assert program.post(f"{calibration}/discard", headers=seen).status_code == 404
        assert program.post(f"{calibration}/step", json={}, headers=seen).status_code == 404
        assert program.get("/v1/rig").json()["state"] == "latched" and service.rig.starts == 0
        assert "I have checked" in browser.get("/").text
        assert forms.press(browser, "/", "/rearm").status_code == 200
        assert program.post("/v1/tests", json=start).status_code == 202


# ---- A key at the terminal stops a running test, in `stimrig test` and in `stimrig serve` ----------------------------


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
