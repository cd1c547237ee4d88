"""People with passwords, keys for controllers, the audit trail's verification, the closed door."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from pathlib import Path
from typing import Any

import argon2
import httpx
import pytest

from stimrig.api.cli import main
from stimrig.api.clock import Clock, utc_label
from stimrig.api.errors import ApiError
from stimrig.api.people import accounts
from stimrig.api.people.auth import Auth, Scope
from stimrig.api.people.pace import Guesses
from stimrig.api.services.context import build
from stimrig.api.settings import Settings
from stimrig.api.store import Store
from stimrig.api.web.server import configuration, loopback, refuse_open_door
from tests.api.conftest import (
    HTML,
    PASSWORD,
    PATIENCE_S,
    TOKEN,
    Service,
    SetClock,
    person,
    run_test,
    signed_in,
    wait_done,
)


def standing_still(service: Service) -> SetClock:
    """The clock of the paces: on a busy machine a wait would be over before the next try."""
    clock = service.context.people.guesses.clock = SetClock()
    return clock


@pytest.fixture
def clinician(service: Service) -> httpx.Client:
    return person(service)


def test_a_password_costs_what_rfc_9106_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accounts, "PasswordHasher", argon2.PasswordHasher)
    kept = accounts.Passwords().hasher.hash(PASSWORD)
    assert argon2.extract_parameters(kept) == argon2.profiles.RFC_9106_LOW_MEMORY


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


def test_a_form_signs_in_and_leads_on_and_another_site_does_not(service: Service, clinician: httpx.Client) -> None:
    with service.client(token=None, follow_redirects=False) as browser:
        form = {"name": "Ada", "password": PASSWORD}
        for target, on in (("/participants/P1", "/participants/P1"), *dict.fromkeys(AWAY, "/").items()):
            answer = browser.post("/v1/sessions", data=form, params={"next": target})
            assert answer.status_code == 303 and answer.headers["location"] == on
        foreign = browser.post("/v1/sessions", data=form, headers={"Origin": "https://elsewhere.example"})
        assert foreign.status_code == 403
        browser.cookies.clear()
        led = browser.get("/participants/P1", headers=HTML)
        assert led.status_code == 303 and led.headers["location"] == "/sign-in?next=/participants/P1"


AWAY = ("//evil.example", "https://evil.example", "/\\evil.example")


def tries(asgi: Any, peer: str, forwarded: list[str]) -> list[int]:
    """Wrong sign-ins from a peer under ever new names, one for each `X-Forwarded-For`; their status codes."""

    async def run() -> list[int]:
        transport = httpx.ASGITransport(app=asgi, client=(peer, 4711))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1", timeout=PATIENCE_S) as http:
            codes = []
            for number, address in enumerate(forwarded):
                form = {"name": f"n{peer}-{number}", "password": "wrong"}
                headers = {"X-Forwarded-For": address} if address else {}
                codes.append((await http.post("/v1/sessions", data=form, headers=headers)).status_code)
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


def test_who_changes_their_own_password_stays_under_a_new_cookie(service: Service) -> None:
    own, other = (person(service, "Root", scopes=["administer"]) for _ in range(2))
    old = dict(own.cookies)
    answer = own.put("/v1/users/Root/password", json={"password": "another passphrase"})
    assert answer.status_code == 204 and "HttpOnly" in answer.headers["set-cookie"]
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
    service: Service, client: httpx.Client, participant: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = str(service.data), tmp_path / "trail.jsonl"
    for number in range(3):
        service.token(f"more {number}", "read-live")
    assert main.run(["audit", "verify", "--data", data, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["whole"] and found["entries"] >= 2
    assert main.run(["audit", "export", "--data", data, "-o", str(out)]) == 0
    assert main.run(["audit", "export", "--data", data, "-o", str(service.data / "stimrig.db")]) == 2
    assert main.run(["audit", "verify", "--file", str(out), "--head", found["head"]]) == 0
    page = tmp_path / "page.jsonl"
    page.write_bytes(client.get("/administration/audit.jsonl").content)
    assert main.run(["audit", "verify", "--file", str(page), "--head", found["head"]]) == 0 and participant
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
    assert main.run(["audit", "verify", "--data", str(tmp_path / "nowhere")]) == 2


# ---- Who may do what: tokens, scopes, sessions, forms


def test_wrong_revoked_and_expired_tokens_are_refused(client: httpx.Client, service: Service) -> None:
    assert service.client("wrong").get("/v1/rig").status_code == 401
    assert service.client(None).get("/v1/rig", headers={"Authorization": "Basic eDp5"}).status_code == 401
    token = service.token("leaver", "read-live")
    assert service.client(token).get("/v1/rig").status_code == 200
    entry = next(row for row in client.get("/v1/tokens").json() if row["name"] == "leaver")
    assert client.delete(f"/v1/tokens/{entry['id']}").status_code == 204
    assert service.client(token).get("/v1/rig").status_code == 401
    late = client.post("/v1/tokens", json={"name": "late", "scopes": ["run-test"], "days": 1}).json()["token"]
    service.sql("UPDATE tokens SET expires_utc = '2020-01-01T00:00:00.000Z' WHERE name = 'late'")
    assert "expired" in service.client(late).get("/v1/rig").json()["detail"]
    assert service.client(late).post("/v1/stop").status_code == 200, "it ran out in a test: it still stops"


def test_database_holds_no_token(service: Service, client: httpx.Client) -> None:
    """Nor a password: its argon2id hash alone."""
    client.post("/v1/users", json={"name": "Ada", "password": PASSWORD})
    token = service.token("someone", "read-live")
    with signed_in(service, token):
        pass
    with sqlite3.connect(service.data / "stimrig.db") as database:
        dump = "\n".join(database.iterdump())
    assert token not in dump and TOKEN not in dump and PASSWORD not in dump and "'$argon2id$" in dump


def test_first_start_draws_a_token_once_and_a_set_one_replaces_the_one_before(tmp_path: Path) -> None:
    contexts = []
    for more in ({}, {}, {"admin_token": "first-one"}, {"admin_token": "second-one"}):
        contexts.append(build(Settings(data_dir=tmp_path, **more)))
        contexts[-1].lock.release()
    drawn = contexts[0].drawn_token
    assert len(drawn or "") > 40 and [context.drawn_token for context in contexts[1:]] == [None] * 3
    for text in (drawn, "second-one"):
        assert contexts[-1].auth.bearer(text).may(Scope.ADMINISTER)
    with pytest.raises(ApiError, match="revoked"):
        contexts[-1].auth.bearer("first-one")


def test_stop_says_so_when_the_rig_is_gone(client: httpx.Client, service: Service) -> None:
    service.rig_thread.__exit__()
    answer = client.post("/v1/stop")
    assert answer.status_code == 503 and "emergency switch" in answer.json()["detail"]


def test_stopped_test_keeps_its_recording_and_makes_no_model(client: httpx.Client, service: Service, participant: str):
    service.rig.speed = 0.5
    test_id = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    client.post("/v1/stop", json={"reason": "pain"})
    document = wait_done(client, test_id)
    assert document["state"] == "stopped" and document["model_id"] is None
    assert client.get(document["recording_url"]).status_code == 200


def test_approval_ends_with_its_day(client: httpx.Client, service: Service, participant: str) -> None:
    document = run_test(client, participant)
    approved = client.post(f"{document['model_url']}/approve").json()
    fetch = f"/v1/participants/{participant}/model"
    assert client.get(fetch).status_code == 200
    clock = service.context.clock
    now = clock.unix_s()
    assert clock.utc() < approved["expires_utc"] <= utc_label(now + 25 * 3600)
    clock.unix_s = lambda: now + 25 * 3600
    gone = client.get(fetch)
    assert gone.status_code == 404 and "ends with its day" in gone.json()["detail"]
    for tracked in (f"{fetch}?tracked=true", f"/v1/participants/{participant}/tracking"):
        assert client.get(tracked).status_code == 404
    assert client.get(document["model_url"]).json()["served"] is False
    client.post(f"{document['model_url']}/approve")
    assert client.get(fetch).status_code == 200


def test_services_of_one_host_leave_one_anothers_cookies_alone(tmp_path: Path) -> None:
    """Browsers tell hosts apart, not ports."""
    stores = [Store(f"sqlite:///{tmp_path}/{name}.db") for name in "ab"]
    clock = Clock()
    names = [Auth(store, clock, Guesses(clock)).cookie_name for store in stores * 2]
    assert len(set(names)) == 2 and names[:2] == names[2:], "one for each, over a restart, too"
    for store in stores:
        store.close()
