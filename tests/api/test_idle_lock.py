"""A session that nobody touches locks: pages ask for the password, stop works, a test goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from stimrig.api.people.auth import IdleLock
from stimrig.api.store import Store
from stimrig.api.store.tables import PageSession
from tests.api.browser import without_values
from tests.api.conftest import HTML, PASSWORD, STUB, TOKEN, Service, SetClock, person, run_service, wait_done
from tests.api.forms import find, press
from tests.api.test_people import standing_still


def test_an_action_that_cannot_be_recorded_refuses_nothing_and_is_not_tried_at_once_again(tmp_path: Path):
    store, clock, tries = Store(f"sqlite:///{tmp_path / 'x.db'}"), SetClock(), []

    def refuse() -> None:
        tries.append(clock.monotonic_s())
        raise OperationalError("INSERT", {}, Exception("disk full"))

    store.write = refuse
    idle = IdleLock(store, clock, 10)
    row = PageSession(hash="h", created_unix_s=clock.unix_s() - 60)
    idle.acted(row)
    idle.acted(row)
    assert len(tries) == 1


SCRIPT = {"Sec-Fetch-Dest": "empty", "Sec-Fetch-Mode": "cors"}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
    for service in run_service(tmp_path_factory.mktemp("idle"), short_dir, STUB, idle_lock_min=10):
        with service.client() as http:
            http.post("/v1/participants", json={"code": "L1"})
        yield service


@pytest.fixture
def clock(service: Service) -> SetClock:
    """Stands still from now on: no busy machine lets a session grow idle."""
    clock = SetClock()
    clock.unix = service.context.clock.unix_s()
    service.context.auth.idle.clock = clock
    return clock


def locked(http: httpx.Client) -> bool:
    """Asked as a script asks, which is nobody's action."""
    now = http.get("/rig/now").json()
    assert now["locked"] != now["signed_in"]
    return now["locked"]


def test_it_locks_after_ten_minutes_without_an_action_on_any_tab(service: Service, clock: SetClock) -> None:
    with closing(person(service)) as http, service.client(token=None, cookies=http.cookies) as other:
        clock.unix += 590
        assert http.post("/v1/sessions/acted").status_code == 204
        clock.unix += 590
        assert not locked(other) and other.get("/", headers=HTML).status_code == 200
        clock.unix += 590
        assert not locked(http)
        clock.unix += 20
        assert locked(http) and locked(other)
        refused = http.get("/v1/rig")
        assert refused.status_code == 401 and refused.json()["type"] == "/problems/locked"
        assert "participant" not in http.get("/rig/now").text, "nothing about a participant"
        page = http.get("/participants/L1?x=1", headers=HTML)
        assert page.status_code == 303
        assert parse_qs(urlsplit(page.headers["location"]).query) == {"next": ["/participants/L1?x=1"]}
        assert http.post("/v1/sessions/unlock", json={"password": PASSWORD}).status_code == 204
        assert http.get("/v1/rig").status_code == 200


@pytest.mark.parametrize(
    ("path", "headers"), [("/rig/now", {}), ("/v1/jobs/none", {}), ("/", {**SCRIPT, **HTML}), ("/v1/rig", SCRIPT)]
)
def test_what_scripts_read_by_themselves_keeps_no_session_open(
    service: Service, clock: SetClock, path: str, headers: dict[str, str]
) -> None:
    with closing(person(service)) as http:
        for _ in range(2):
            clock.unix += 295
            http.get(path, headers=headers)
        clock.unix += 295
        assert locked(http)


def test_what_is_sent_from_a_locked_page_does_nothing_and_needs_its_own_token(service: Service, clock: SetClock):
    with closing(person(service)) as http:
        clock.unix += 900
        assert http.post("/v1/participants", json={"code": "L9"}).status_code == 401
        shown = http.get("/locked", headers=HTML).text
        assert "Ada" in shown
        assert press(http, "", "/unlock", html=shown, password="no").status_code == 401 and locked(http)
        for target in (
            "https://evil.example/",
            "//evil.example",
            "/\\evil.example",
            "/\t/evil.example",
            "javascript:x",
        ):
            page = http.get("/locked", params={"next": target}, headers=HTML).text
            assert find(page, "/unlock")[1]["data-next"] == "/", target
        csrf = http.headers.pop("X-CSRF-Token")
        assert http.post("/v1/sessions/unlock", json={"password": PASSWORD}).status_code == 403
        http.headers["X-CSRF-Token"] = csrf
        assert press(http, "", "/unlock", html=shown, password=PASSWORD).status_code == 204 and not locked(http)
    with service.client() as admin:
        assert admin.get("/v1/participants/L9").status_code == 404


def test_guesses_at_the_lock_are_held_to_a_pace(service: Service, clock: SetClock) -> None:
    standing_still(service)
    with closing(person(service, "Jörg Müller")) as http:
        http.post("/v1/sessions/lock")
        tries = [http.post("/v1/sessions/unlock", json={"password": f"no {n}"}).status_code for n in range(6)]
        assert tries == [401] * 5 + [429]
        held = http.post("/v1/sessions/unlock", json={"password": PASSWORD})
        assert held.status_code == 429 and int(held.headers["retry-after"]) > 0 and locked(http)
        with closing(person(service)) as other:
            other.post("/v1/sessions/lock")
            assert other.post("/v1/sessions/unlock", json={"password": PASSWORD}).status_code == 204, "others wait not"


def test_the_red_button_works_on_a_locked_page(service: Service, clock: SetClock) -> None:
    service.rig.speed = 1.0
    with closing(person(service)) as http:
        test = http.post("/v1/tests", json={"participant": "L1"}).json()
        http.post("/v1/sessions/lock")
        page = http.get("/locked", headers=HTML).text
        assert 'id="stop"' in page and "L1" not in without_values(page) and "Ada" in page
        assert service.rig.state == "running", "the test is not touched"
        right = page.split('name="right" value="')[1].split('"')[0]
        with service.client(token=None) as nobody:
            assert nobody.post("/v1/stop", data={"right": right}).status_code == 200
        told = http.post("/v1/stop", data={"right": right}, headers=HTML, follow_redirects=True).text
        assert "The rig confirms" in told and "See what was recorded" not in told, "nothing about the test"
        assert locked(http)
        with service.client() as admin:
            assert wait_done(admin, test["id"])["state"] == "stopped"
            admin.post("/v1/rearm")
        assert http.post("/v1/stop").status_code == 200, "and by the session itself"
    with service.client() as admin:
        admin.post("/v1/rearm")


def test_a_session_by_token_asks_for_the_token(service: Service, clock: SetClock) -> None:
    with service.client(token=None) as http:
        http.post("/v1/sessions", data={"token": TOKEN})
        assert press(http, "/", "/lock").status_code == 204 and locked(http)
        form = http.get("/locked", headers=HTML).text
        assert "Access token" in form
        assert press(http, "", "/unlock", html=form, password=PASSWORD).status_code == 401
        assert press(http, "", "/unlock", html=form, password=TOKEN).status_code == 204
        assert not locked(http)


def test_somebody_else_may_leave_for_the_one_who_is_gone(service: Service, clock: SetClock) -> None:
    with closing(person(service)) as http:
        http.post("/v1/sessions/lock")
        assert press(http, "/locked", "DELETE /v1/sessions/current").status_code == 204
        assert http.get("/v1/rig").json()["type"] == "/problems/unauthorized"


def test_a_lock_holds_over_a_restart(tmp_path: Path, short_dir: Path) -> None:
    cookies: Any = None
    for first in run_service(tmp_path, short_dir, STUB, idle_lock_min=10):
        with closing(person(first)) as http:
            http.post("/v1/sessions/lock")
            cookies = dict(http.cookies)
    for second in run_service(tmp_path, short_dir, STUB, idle_lock_min=10):
        with second.client(token=None, cookies=cookies) as http:
            assert locked(http)


def test_an_action_is_written_down(service: Service, clock: SetClock) -> None:
    context = service.context
    with closing(person(service)) as http:
        row = context.auth.cookie(http.cookies[context.auth.cookie_name]).page_session
        clock.unix += 500
        context.auth.idle.acted(row)
        kept = context.store.get(type(row), row.hash)
        for later_s, expected in ((500, False), (200, True)):
            clock.unix += later_s
            assert context.auth.idle.locked(kept) is expected
        assert not IdleLock(context.store, clock, 0).locked(kept), "0: never"
