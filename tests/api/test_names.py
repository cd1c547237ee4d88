"""Names of people: spaces and umlauts, one way to write each, nobody twice; in the API, on pages, in the trail."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api.clock import Clock
from stimrig.api.people import accounts
from stimrig.api.people.pace import Guesses
from stimrig.api.sessions.stops import StopRights
from tests.api.browser import PASSWORD
from tests.api.conftest import STUB, Service, run_service

JOERG = "Jörg Müller-Lüdenscheidt"
DECOMPOSED = " Jo\u0308rg\u00a0 Mu\u0308ller-Lüdenscheidt "
SAME = ["jörg müller-lüdenscheidt", "  JO\u0308RG\u00a0 MU\u0308LLER-LÜDENSCHEIDT ", "Jörg\u3000Müller-Lüdenscheidt"]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[Service]:
    for service in run_service(tmp_path_factory.mktemp("names"), short_dir, STUB):
        with service.client() as http:
            answer = http.post("/v1/users", json={"name": DECOMPOSED, "password": PASSWORD})
            assert answer.status_code == 201 and answer.json()["name"] == JOERG
        yield service


@pytest.fixture
def http(service: Service) -> Iterator[httpx.Client]:
    """What other tests guessed in vain counts no more: they may come in any order."""
    guesses = service.context.people.guesses
    vars(guesses).update(vars(Guesses(Clock())))
    with service.client() as client:
        yield client


@pytest.mark.parametrize("name", SAME)
def test_a_name_means_one_person_however_it_is_typed(service: Service, http: httpx.Client, name: str) -> None:
    taken = http.post("/v1/users", json={"name": name, "password": PASSWORD})
    assert taken.status_code == 409 and JOERG in taken.json()["detail"]
    with service.client(token=None) as browser:
        signed = browser.post("/v1/sessions", json={"name": name, "password": PASSWORD})
        assert signed.status_code == 201 and signed.json()["name"] == JOERG
        page = browser.post("/v1/sessions", data={"name": name, "password": PASSWORD})
        assert page.status_code == 303
        assert JOERG in browser.get("/", headers={"Accept": "text/html"}).text
    last = http.get("/v1/audit").json()["entries"][-1]
    assert (last["who"], last["action"]) == (JOERG, "sign in")


def test_a_name_stands_in_addresses(service: Service, http: httpx.Client) -> None:
    http.post("/v1/users", json={"name": "Zoë O’Brien", "password": PASSWORD})
    shown = http.get("/administration", headers={"Accept": "text/html"}).text
    assert f"DELETE /v1/users/{quote('Zoë O’Brien')}" in shown
    new = {"password": "another long password"}
    assert http.put(f"/v1/users/{quote('zoë o’brien')}/password", json=new).status_code == 204
    with service.client(token=None) as browser:
        assert browser.post("/v1/sessions", json={"name": "Zoë O’Brien", **new}).status_code == 201
        assert http.delete(f"/v1/users/{quote('Zoë O’Brien')}").status_code == 204
        assert browser.post("/v1/sessions", json={"name": "Zoë O’Brien", **new}).status_code == 401


@pytest.mark.parametrize(
    "name",
    ["", " ", "..", "\u3164", "a\u202eb", "a\u200bb", "a\x00b", "a\nb", "a/b", "<b>", "Аda", "x" * 81, "x" * 100_000],
    ids=lambda name: ascii(name)[:20],
)
def test_what_is_no_name_is_refused_and_signs_nobody_in(service: Service, http: httpx.Client, name: str) -> None:
    refused = http.post("/v1/users", json={"name": name, "password": PASSWORD})
    assert refused.status_code == 422 and len(refused.text) < 1500
    with service.client(token=None) as browser:
        assert browser.post("/v1/sessions", json={"name": name, "password": PASSWORD}).status_code == 401


def test_a_try_under_a_name_that_postgresql_takes_not_is_written_down(service: Service, http: httpx.Client) -> None:
    with service.client(token=None) as browser:
        assert browser.post("/v1/sessions", json={"name": "a\x00b", "password": PASSWORD}).status_code == 401
    trail = http.get("/v1/audit").json()
    last = trail["entries"][-1]
    assert (last["who"], last["action"]) == ("a\ufffdb", "sign in refused") and trail["whole"]


@given(st.text(max_size=90))
def test_a_written_name_stays_as_it_is(text: str) -> None:
    try:
        once = accounts.written_name(text)
    except ValueError as error:
        assert str(error) and str(error).isprintable()
        return
    assert accounts.written_name(once) == once and accounts.folded_name(once) == accounts.folded_name(text)
    assert once == once.strip() and len(once) <= accounts.LONGEST


def test_a_page_of_the_longest_name_may_stop() -> None:
    rights = StopRights(b"k" * 32, Clock())
    name = "𐓏" * accounts.LONGEST
    assert rights.holder(rights.give(accounts.written_name(name), "T20260301T100000-abcdef")) == name
