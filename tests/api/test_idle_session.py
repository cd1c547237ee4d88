"""A session that nobody touches ends: pages lead to the sign-in, stop works, a test goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from stimrig.api.people.auth import Auth
from stimrig.api.people.pace import Guesses
from stimrig.api.store import Store
from stimrig.api.store.tables import PageSession
from tests.api.browser import without_values
from tests.api.conftest import HTML, STUB, Service, SetClock, person, run_service, wait_done


def test_an_action_that_cannot_be_recorded_refuses_nothing_and_is_not_tried_at_once_again(tmp_path: Path):
    store, clock, tries = Store(f"sqlite:///{tmp_path / 'x.db'}"), SetClock(), []
    auth = Auth(store, clock, Guesses(clock), 10)

    def refuse() -> None:
        tries.append(clock.monotonic_s())
        raise OperationalError("INSERT", {}, Exception("disk full"))

    store.write = refuse
    row = PageSession(hash="h", created_unix_s=clock.unix_s() - 60)
    auth.record_action(row)
    auth.record_action(row)
    assert len(tries) == 1


SCRIPT = {"Sec-Fetch-Dest": "empty", "Sec-Fetch-Mode": "cors"}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
    for service in run_service(tmp_path_factory.mktemp("idle"), short_dir, STUB, idle_min=10):
        with service.client() as http:
            http.post("/v1/participants", json={"code": "L1"})
        yield service


@pytest.fixture
def clock(service: Service) -> SetClock:
    """Stands still from now on: no busy machine lets a session grow idle."""
    clock = SetClock()
    clock.unix = service.context.clock.unix_s()
    service.context.auth.clock = clock
    return clock


def ended(http: httpx.Client) -> bool:
    """Asked as a script asks, which is nobody's action."""
    now = http.get("/rig/now").json()
    assert now["ended"] != now["signed_in"]
    return now["ended"]


def test_it_ends_after_ten_minutes_without_an_action_on_any_tab(service: Service, clock: SetClock) -> None:
    with closing(person(service)) as http, service.client(token=None, cookies=http.cookies) as other:
        clock.unix += 590
        assert http.post("/v1/sessions/acted").status_code == 204
        clock.unix += 590
        assert not ended(other) and other.get("/", headers=HTML).status_code == 200
        clock.unix += 590
        assert not ended(http)
        clock.unix += 20
        assert ended(http) and ended(other)
        assert http.get("/v1/rig").status_code == 401
        assert http.post("/v1/participants", json={"code": "L9"}).status_code == 401
        assert http.post("/v1/sessions/acted").status_code == 401, "no action brings it back"
        assert "participant" not in http.get("/rig/now").text, "nothing about a participant"
        page = http.get("/participants/L1?x=1", headers=HTML)
        assert page.status_code == 303
        assert parse_qs(urlsplit(page.headers["location"]).query) == {"next": ["/participants/L1?x=1"]}
        assert ended(http) and http.delete("/v1/sessions/current").status_code == 401


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
        assert ended(http)


def test_the_red_button_works_when_the_session_has_ended(service: Service, clock: SetClock) -> None:
    service.rig.speed = 1.0
    with closing(person(service)) as http:
        test = http.post("/v1/tests", json={"participant": "L1"}).json()
        clock.unix += 900
        page = http.get("/sign-in", headers=HTML).text
        assert 'id="stop"' in page and "L1" not in without_values(page)
        assert service.rig.state == "running", "the test is not touched"
        right = page.split('name="right" value="')[1].split('"')[0]
        with service.client(token=None) as nobody:
            assert nobody.post("/v1/stop", data={"right": right}).status_code == 200
        told = http.post("/v1/stop", data={"right": right}, headers=HTML, follow_redirects=True).text
        assert "The rig confirms" in told and "See what was recorded" not in told, "nothing about the test"
        assert ended(http)
        with service.client() as admin:
            assert wait_done(admin, test["id"])["state"] == "stopped"
            admin.post("/v1/rearm")
        assert http.post("/v1/stop").status_code == 200, "and by the session itself"
    with service.client() as admin:
        admin.post("/v1/rearm")


def test_an_action_is_written_down(service: Service, clock: SetClock) -> None:
    auth = service.context.auth
    with closing(person(service)) as http:
        row = auth.cookie(http.cookies[auth.cookie_name]).page_session
        assert row is not None
        clock.unix += 500
        auth.record_action(row)
        kept = service.context.store.get(PageSession, row.hash)
        for later_s, expected in ((500, False), (200, True)):
            clock.unix += later_s
            assert auth.has_ended(kept) is expected
        assert not Auth(service.context.store, clock, Guesses(clock), 0).has_ended(kept), "0: never"
