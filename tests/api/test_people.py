"""People with passwords, keys for controllers, the audit trail's verification, the closed door."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import argon2
import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import inspect

from stimrig.api.cli import main
from stimrig.api.clock import Clock
from stimrig.api.people import accounts
from stimrig.api.people.pace import Guesses, Pace
from stimrig.api.sessions.stops import StopRights
from stimrig.api.settings import Settings
from stimrig.api.web.server import configuration, loopback, refuse_open_door
from tests.api.centre.conftest import run_centre
from tests.api.conftest import PATIENCE_S, STUB, TOKEN, Service, SetClock, run_service, run_test

PASSWORD = "correct horse battery"


def standing_still(service: Service) -> SetClock:
    """The clock of the paces: on a busy machine a wait would be over before the next try."""
    clock = SetClock()
    for pace in vars(service.app.state.context.people.guesses).values():
        if isinstance(pace, Pace):
            pace.clock = clock
    return clock


@pytest.fixture
def clinician(service: Service, client: httpx.Client) -> httpx.Client:
    assert client.post("/v1/users", json={"name": "Ada", "password": PASSWORD}).status_code == 201
    browser = service.client(token=None)
    answer = browser.post("/v1/sessions", json={"name": "Ada", "password": PASSWORD})
    assert answer.status_code == 201, answer.text
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    browser.headers["X-CSRF-Token"] = answer.json()["csrf"]
    return browser


def test_a_password_costs_what_rfc_9106_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accounts, "PasswordHasher", argon2.PasswordHasher)
    kept = accounts.Passwords().hasher.hash(PASSWORD)
    assert argon2.extract_parameters(kept) == argon2.profiles.RFC_9106_LOW_MEMORY


def test_password_is_kept_as_argon2id_only(service: Service, clinician: httpx.Client) -> None:
    assert clinician.get("/v1/rig").status_code == 200
    ((kept,),) = service.sql("SELECT password_hash FROM users")
    assert kept.startswith("$argon2id$")
    tables = inspect(service.app.state.context.store.engine).get_table_names()
    assert not any(PASSWORD in str(service.sql(f"SELECT * FROM {table}")) for table in tables)


def test_approval_needs_the_password_once_more(
    service: Service, client: httpx.Client, clinician: httpx.Client, participant: str
) -> None:
    model_url = run_test(client, participant)["model_url"]
    refused = clinician.post(f"{model_url}/approve", json={"reason": "good"})
    assert refused.status_code == 403 and refused.json()["type"] == "/problems/confirm-password"
    assert client.get(f"/v1/participants/{participant}/model").status_code == 404
    assert clinician.post("/v1/sessions/confirm", json={"password": "not that"}).status_code == 401
    assert clinician.post(f"{model_url}/approve").status_code == 403
    assert clinician.post("/v1/sessions/confirm", json={"password": PASSWORD}).status_code == 204
    assert clinician.post(f"{model_url}/approve", json={"reason": "good"}).json()["decided_by"] == "Ada"
    again = clinician.post(f"{model_url}/reject", json={"reason": "slipped"})
    assert again.status_code == 403, "a confirmation is good for one decision"


def test_form_approval_carries_the_password(client: httpx.Client, clinician: httpx.Client, participant: str) -> None:
    model_id = run_test(client, participant)["model_id"]
    fields = {"csrf": clinician.headers["X-CSRF-Token"], "reason": "good"}
    assert clinician.post(f"/models/{model_id}/approve", data=fields).status_code == 403
    assert clinician.post(f"/models/{model_id}/approve", data=fields | {"password": "wrong word"}).status_code == 401
    assert clinician.post(f"/models/{model_id}/approve", data=fields | {"password": PASSWORD}).status_code == 303
    assert client.get(f"/v1/participants/{participant}/model").status_code == 200


def test_a_form_signs_in_and_leads_on_and_another_site_does_not(service: Service, clinician: httpx.Client) -> None:
    with service.client(token=None, follow_redirects=False) as browser:
        form = {"name": "Ada", "password": PASSWORD, "next": "/participants/P1"}
        foreign = browser.post("/v1/sessions", data=form, headers={"Origin": "https://elsewhere.example"})
        assert foreign.status_code == 403
        answer = browser.post("/v1/sessions", data=form)
        assert answer.status_code == 303 and answer.headers["location"] == "/participants/P1"
        elsewhere = browser.post("/sign-in", data=form, headers={"Origin": "https://elsewhere.example"})
        assert elsewhere.status_code == 403
        away = browser.post("/v1/sessions", data=form | {"next": "//elsewhere.example"})
        assert away.headers["location"] == "/"


def tries(asgi: Any, peer: str, forwarded: list[str], token: bool = False) -> list[int]:
    """Wrong sign-ins from a peer under ever new names, one for each `X-Forwarded-For`; their status codes."""

    async def run() -> list[int]:
        transport = httpx.ASGITransport(app=asgi, client=(peer, 4711))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1", timeout=PATIENCE_S) as http:
            codes = []
            for number, address in enumerate(forwarded):
                form = {"token": "wrong"} if token else {"name": f"n{peer}-{number}", "password": "wrong"}
                headers = {"X-Forwarded-For": address} if address else {}
                codes.append((await http.post("/sign-in", data=form, headers=headers)).status_code)
            return codes

    return asyncio.run(run())


def test_behind_a_proxy_of_this_machine_addresses_are_told_apart(service: Service) -> None:
    """nginx on loopback names the client; anybody else's word for it is not taken."""
    standing_still(service)
    config = configuration(service.app)
    config.load()
    asgi = config.loaded_app
    assert tries(asgi, "127.0.0.1", ["10.0.0.1"] * 7) == [401] * 5 + [429] * 2
    assert tries(asgi, "127.0.0.1", ["10.0.0.2"]) == [401], "another client of the proxy is not held back"
    assert tries(asgi, "::1", ["10.0.0.1"]) == [429], "the same one is, whichever loopback the proxy uses"
    invented = [f"192.0.2.{k}, 10.0.0.3" for k in range(6)]
    assert tries(asgi, "127.0.0.1", invented) == [401] * 5 + [429], "its own inventions don't count"
    assert tries(asgi, "10.0.0.9", [f"192.0.2.{k}" for k in range(6)]) == [401] * 5 + [429], "no proxy, no belief"


def test_changed_password_and_removal_end_sessions(client: httpx.Client, clinician: httpx.Client) -> None:
    assert client.put("/v1/users/Ada/password", json={"password": "another passphrase"}).status_code == 204
    assert clinician.get("/v1/rig").status_code == 401
    for password, status in ((PASSWORD, 401), ("another passphrase", 201)):
        assert clinician.post("/v1/sessions", json={"name": "Ada", "password": password}).status_code == status
    assert client.delete("/v1/users/Ada").status_code == 204
    assert clinician.get("/v1/rig").status_code == 401
    assert client.post("/v1/users", json={"name": "Ada", "password": PASSWORD}).status_code == 409
    assert client.post("/v1/users", json={"name": "Eve", "password": "short"}).status_code == 422


@pytest.mark.parametrize("by_form", [False, True])
def test_who_changes_their_own_password_stays_under_a_new_cookie(service: Service, by_form: bool) -> None:
    with service.client() as client:
        client.post("/v1/users", json={"name": "Root", "password": PASSWORD, "scopes": ["administer"]})
    own, other = service.client(token=None), service.client(token=None)
    for browser in (own, other):
        signed = browser.post("/v1/sessions", json={"name": "Root", "password": PASSWORD}).json()
        browser.headers["X-CSRF-Token"] = signed["csrf"]
    old = dict(own.cookies)
    if by_form:
        answer = own.post("/administration/users/Root/password", data={"password": "another passphrase"})
    else:
        answer = own.put("/v1/users/Root/password", json={"password": "another passphrase"})
    assert answer.status_code in (204, 303) and "HttpOnly" in answer.headers["set-cookie"]
    assert dict(own.cookies) != old and own.get("/v1/users").status_code == 200
    assert own.post("/v1/stop").status_code == 200 and own.post("/v1/rearm").status_code == 200, "its forms stay good"
    assert other.get("/v1/users").status_code == 401, "every other session has ended"
    assert service.client(token=None, cookies=old).get("/v1/users").status_code == 401, "so has the old cookie"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::", "rig.clinic.example"])
def test_other_addresses_than_loopback_are_refused_without_tls(host: str) -> None:
    assert not loopback(host)
    with pytest.raises(OSError, match="STIMRIG_TLS_PROXY"):
        refuse_open_door(Settings(host=host, secure_cookies=True))
    refuse_open_door(Settings(host=host, secure_cookies=True, tls_proxy=True))
    for own in ("127.0.0.1", "::1", "localhost", "127.0.0.9"):
        refuse_open_door(Settings(host=own))


def test_audit_is_verified_and_exported_by_a_command(
    service: Service, participant: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = str(service.data), tmp_path / "trail.jsonl"
    for number in range(3):
        service.token(f"more {number}", "read-live")
    assert main.run(["audit", "verify", "--data", data, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["whole"] and found["entries"] >= 2
    assert main.run(["audit", "export", "--data", data, "-o", str(out)]) == 0
    assert main.run(["audit", "verify", "--file", str(out), "--head", found["head"]]) == 0
    lines = out.read_text().splitlines()
    for tampered in (
        lines[:1] + lines[2:],
        [lines[0], *lines[1:-1], lines[-1].replace("more 2", "more 9")],
        [lines[1], lines[0]],
    ):
        out.write_text("\n".join(tampered) + "\n")
        assert main.run(["audit", "verify", "--file", str(out)]) == 1
    out.write_text(lines[0] + "\n")
    assert main.run(["audit", "verify", "--file", str(out), "--head", found["head"]]) == 1, "a cut end is found"
    service.sql("UPDATE audit SET who = 'somebody else' WHERE seq = 2")
    capsys.readouterr()
    assert main.run(["audit", "verify", "--data", data]) == 1
    assert "broken at entry 2" in capsys.readouterr().out


@pytest.mark.sqlite
def test_an_audit_of_no_database_is_told(tmp_path: Path) -> None:
    assert main.run(["audit", "verify", "--data", str(tmp_path / "nowhere")]) == 2


JOERG = "Jörg Müller-Lüdenscheidt"
DECOMPOSED = " Jo\u0308rg\u00a0 Mu\u0308ller-Lüdenscheidt "
SAME = [
    JOERG,
    "jörg müller-lüdenscheidt",
    "  JO\u0308RG\u00a0 MU\u0308LLER-LÜDENSCHEIDT ",
    "Jörg\u3000Müller-Lüdenscheidt",
]


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
    guesses = service.app.state.context.people.guesses
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
        page = browser.post("/sign-in", data={"name": name, "password": PASSWORD})
        assert page.status_code == 303
        assert JOERG in browser.get("/", headers={"Accept": "text/html"}).text
    last = http.get("/v1/audit").json()["entries"][-1]
    assert (last["who"], last["action"]) == (JOERG, "sign in")


def test_a_name_stands_in_addresses(service: Service, http: httpx.Client) -> None:
    http.post("/v1/users", json={"name": "Zoë O’Brien", "password": PASSWORD})
    new = "another long password"
    assert http.put(f"/v1/users/{quote('zoë o’brien')}/password", json={"password": new}).status_code == 204
    with service.client(token=None) as browser:
        assert browser.post("/v1/sessions", json={"name": "Zoë O’Brien", "password": new}).status_code == 201
    shown = http.get("/administration", headers={"Accept": "text/html"}).text
    assert f"/administration/users/{quote('Zoë O’Brien')}/remove" in shown
    assert http.post(f"/administration/users/{quote('Zoë O’Brien')}/remove").status_code == 303
    with service.client(token=None) as browser:
        assert browser.post("/v1/sessions", json={"name": "Zoë O’Brien", "password": new}).status_code == 401


@pytest.mark.parametrize(
    "name",
    ["", " ", "..", "\u3164", "a\u202eb", "a\u200bb", "a\x00b", "a\nb", "a/b", "<b>", "Аda", "x" * 81, "x" * 100_000],
    ids=lambda name: ascii(name)[:20],
)
def test_what_is_no_name_is_refused_and_signs_nobody_in(service: Service, http: httpx.Client, name: str) -> None:
    refused = http.post("/v1/users", json={"name": name, "password": PASSWORD})
    assert refused.status_code == 422 and len(refused.text) < 1500
    form = http.post("/administration/users", data={"name": name, "role": "reader", "password": PASSWORD})
    assert form.status_code == 422
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


def test_half_a_character_is_refused(http: httpx.Client) -> None:
    body = '{"name": "\\ud800", "password": "long enough, I think"}'
    headers = {"Content-Type": "application/json"}
    for path in ("/v1/users", "/v1/sessions"):
        assert http.post(path, content=body, headers=headers).status_code in (400, 401, 422)


@pytest.fixture
def urls(tmp_path: Path, short_dir: Path) -> Iterator[list[str]]:
    """Services of two rigs, and a centre."""
    for one in run_service(tmp_path / "a", short_dir, STUB):
        for other in run_service(tmp_path / "b", tmp_path, STUB):
            for centre in run_centre(tmp_path / "centre"):
                yield [one.url, other.url, centre.url]


def test_one_browser_stays_signed_in_at_every_service_of_a_host(urls: list[str]) -> None:
    for url in urls:
        answer = httpx.post(
            f"{url}/v1/users", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60,
            json={"name": "Ada", "password": PASSWORD, "scopes": ["administer"]},
        )  # fmt: skip
        assert answer.status_code == 201, answer.text
    with httpx.Client(timeout=60) as browser:
        csrf = {}
        for url in urls:
            csrf[url] = browser.post(f"{url}/v1/sessions", json={"name": "Ada", "password": PASSWORD}).json()["csrf"]
        assert len(browser.cookies) == len(urls)
        assert [browser.get(f"{url}/v1/users").status_code for url in urls] == [200, 200, 200]
        browser.delete(f"{urls[0]}/v1/sessions/current", headers={"X-CSRF-Token": csrf[urls[0]]}).raise_for_status()
        assert [browser.get(f"{url}/v1/users").status_code for url in urls] == [401, 200, 200]
