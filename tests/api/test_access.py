"""Who may do what: tokens, scopes, sessions, forms."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest

from stimrig.api.clock import utc_label
from stimrig.api.people.auth import Scope
from stimrig.api.settings import Settings
from tests.api.conftest import TOKEN, Service, run_test, wait_done

HTML = {"Accept": "text/html,application/xhtml+xml"}


@contextmanager
def signed_in(service: Service, token: str = TOKEN) -> Iterator[httpx.Client]:
    with service.client(token=None, headers=HTML, follow_redirects=False) as browser:
        answer = browser.post("/sign-in", data={"token": token, "next": "/"})
        assert answer.status_code == 303, answer.text
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie and "SameSite=strict" in cookie
        yield browser


def csrf(browser: httpx.Client) -> str:
    return re.findall(r'name="csrf" value="([^"]+)"', browser.get("/").text)[0]


def test_wrong_revoked_and_expired_tokens_are_refused(client: httpx.Client, service: Service) -> None:
    assert service.client("wrong").get("/v1/rig").status_code == 401
    assert service.client(None).get("/v1/rig", headers={"Authorization": "Basic eDp5"}).status_code == 401
    token = service.token("leaver", "read-live")
    assert service.client(token).get("/v1/rig").status_code == 200
    entry = next(row for row in client.get("/v1/tokens").json() if row["name"] == "leaver")
    assert client.delete(f"/v1/tokens/{entry['id']}").status_code == 204
    assert service.client(token).get("/v1/rig").status_code == 401
    body = {"name": "late", "scopes": ["run-test"], "expires_utc": "2020-01-01T00:00:00Z"}
    late = client.post("/v1/tokens", json=body).json()["token"]
    assert "expired" in service.client(late).get("/v1/rig").json()["detail"]
    assert service.client(late).post("/v1/stop").status_code == 200, "it ran out in a test: it still stops"


@pytest.mark.parametrize(
    ("end", "kept"),
    [
        ("2999-01-01T00:00:05Z", "2999-01-01T00:00:05.000Z"),
        ("2026-99-99T00:00:00Z", None),
        ("٢٠٢٠-٠١-٠١T00:00:00Z", None),
    ],
)
def test_the_end_of_a_token_is_a_time_and_is_kept_as_the_clock_writes_it(
    client: httpx.Client, end: str, kept: str | None
) -> None:
    answer = client.post("/v1/tokens", json={"name": "timed", "scopes": ["run-test"], "expires_utc": end})
    assert answer.json().get("expires_utc") == kept and answer.status_code == (201 if kept else 422)


def test_database_holds_no_token(service: Service) -> None:
    token = service.token("someone", "read-live")
    with signed_in(service, token):
        pass
    with sqlite3.connect(service.data / "stimrig.db") as database:
        dump = "\n".join(database.iterdump())
    assert token not in dump and TOKEN not in dump


def test_first_start_draws_a_token_once(tmp_path) -> None:
    from stimrig.api.web.dependencies import build

    settings = Settings(data_dir=tmp_path)
    first = build(settings)
    first.lock.release()
    second = build(settings)
    assert first.drawn_token is not None and len(first.drawn_token) > 40
    assert second.drawn_token is None
    assert second.auth.bearer(first.drawn_token).may(Scope.ADMINISTER)


def test_changing_the_set_token_withdraws_the_old_one(tmp_path) -> None:
    from stimrig.api.errors import ApiError
    from stimrig.api.web.dependencies import build

    build(Settings(data_dir=tmp_path, admin_token="first-one")).lock.release()  # pyright: ignore[reportArgumentType]
    later = build(Settings(data_dir=tmp_path, admin_token="second-one"))  # pyright: ignore[reportArgumentType]
    assert later.auth.bearer("second-one").may(Scope.ADMINISTER)
    with pytest.raises(ApiError, match="revoked"):
        later.auth.bearer("first-one")


def test_signing_out_ends_the_session(service: Service) -> None:
    with signed_in(service) as browser:
        cookie = dict(browser.cookies)
        browser.post("/sign-out", data={"csrf": csrf(browser)})
        answer = service.client(None, cookies=cookie).get("/v1/rig")
        assert answer.status_code == 401


def test_sign_in_leads_nowhere_else(service: Service) -> None:
    with service.client(None, headers=HTML) as browser:
        for target in ("//evil.example", "https://evil.example", "/\\evil.example"):
            answer = browser.post("/sign-in", data={"token": TOKEN, "next": target})
            assert answer.headers["location"] == "/"
        wrong = browser.post("/sign-in", data={"token": "wrong"})
        assert wrong.status_code == 401 and "unknown" in wrong.text
    with service.client(None, headers=HTML) as stranger:
        led = stranger.get("/participants/P1")
        assert led.status_code == 303 and led.headers["location"] == "/sign-in?next=/participants/P1"


# ---- stop ---------------------------------------------------------------------------------------------------


def test_stop_by_json_and_without_a_body_says_the_rigs_evidence(
    client: httpx.Client, service: Service, participant: str
) -> None:
    service.rig.speed = 0.5
    client.post("/v1/tests", json={"participant": participant})
    answer = client.post("/v1/stop", json={"reason": "pain"}).json()
    assert answer["stopped"] and answer["evidence"]["device_state"] == "stopped"
    assert client.post("/v1/stop").json()["stopped"]


def test_stop_is_open_to_anyone_signed_in_and_to_nobody_else(service: Service) -> None:
    assert service.client(service.token("reader", "read-model")).post("/v1/stop").status_code == 200
    assert service.client(None).post("/v1/stop").status_code == 401


def test_stop_by_plain_form_works_without_csrf_and_after_the_session_ran_out(
    service: Service, participant: str
) -> None:
    service.rig.speed = 0.5
    with signed_in(service) as browser:
        with service.client() as client:
            client.post("/v1/tests", json={"participant": participant})
        with service.app.state.context.store.write() as session:
            session.connection().exec_driver_sql("UPDATE page_sessions SET expires_unix_s = 0")
        assert browser.get("/v1/rig").status_code in (303, 401)
        page = browser.post("/v1/stop", data={"reason": "stop pressed on the page"}, follow_redirects=True)
        assert page.status_code == 200
        assert "The rig confirms that stimulation is off" in page.text
    assert service.rig.stopped_by == "administrator"


def test_stop_says_so_when_the_rig_is_gone(client: httpx.Client, service: Service) -> None:
    service.rig_thread.__exit__()
    answer = client.post("/v1/stop")
    assert answer.status_code == 503 and "emergency switch" in answer.json()["detail"]


def test_stopped_test_keeps_its_recording_and_makes_no_model(
    client: httpx.Client, service: Service, participant: str
) -> None:
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
    clock = service.app.state.context.clock
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
