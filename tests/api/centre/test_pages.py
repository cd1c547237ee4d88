"""The centre's pages: every route for every holder; what a rig sends is shown, and never run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import httpx
import pytest
from fastapi.routing import APIRoute

from stimrig.api.centre import app as centre_app
from stimrig.api.centre.pages import doubts
from stimrig.api.store.centre_tables import CentreRig
from stimrig.rig.messages import RigState
from tests.api.centre.conftest import Centre, Teller, run_centre
from tests.api.conftest import TOKEN
from tests.api.test_scopes import ROWS as SCOPES

HOLDERS = ("nobody", "reader", "rig", "administrator")
SHARED = """
/health /metrics /static/page.css /docs /sign-in /language /colours /v1/sessions /sign-out /locked /unlock
/lock /rig/acted /v1/sessions/lock /v1/sessions/unlock /v1/sessions/current /v1/users /v1/users/x/password
/v1/users/x /v1/tokens /v1/tokens/x /v1/audit /administration /administration/users
/administration/users/x/password /administration/users/x/remove /administration/keys
/administration/tokens/x/revoke /administration/audit.jsonl

"""
"""What a centre answers as a rig's service does: who may, stands in tests/api/test_scopes.py."""
TABLE = """
GET    /                                          page           200
GET    /v1/rigs                                   reader         200
GET    /v1/warnings                               reader         200
GET    /v1/participants                           reader         200
GET    /v1/participants/x/sessions                reader         404
GET    /v1/recordings                             reader         200
GET    /v1/recordings/1                           reader         404
GET    /v1/rigs/x/models/x/file                   reader         404
GET    /participants                              reader         200
GET    /participants/x                            reader         404
GET    /warnings                                  reader         200
POST   /v1/rigs                                   administrator  422
DELETE /v1/rigs/x                                 administrator  404
POST   /v1/warnings/1/acknowledge                 administrator  404
POST   /rigs                                      administrator  422
POST   /rigs/x/revoke                             administrator  404
POST   /warnings/1/acknowledge                    administrator  404
POST   /v1/rig/hello                              rig            400
POST   /v1/rig/items                              rig            400
GET    /v1/rig/files                              rig            200
GET    /v1/rig/heads                              rig            200
PUT    /v1/rig/files/{zeros}                      rig            404
"""
"""Method, path, who may, and what they are answered, where nothing of the name x is there and no body is sent."""
ROWS = [tuple(line.replace("{zeros}", "0" * 64).split()) for line in TABLE.strip().splitlines()]
ROWS += [
    (*row[:2], row[2].replace("administer", "administrator"), row[3]) for row in SCOPES if row[1] in SHARED.split()
]
IN_PATHS = {"{recording_id}": "1", "{warning_id}": "1", "{sha256}": "0" * 64}
HOSTILE = ["../../etc/passwd", "'; DROP TABLE centre_rigs; --", "<script>boom()</script>", "a\x00b", "\u202egnp.exe"]


def filled(path: str) -> str:
    path = path.replace("/static/{name}", "/static/page.css")
    return re.sub(r"\{\w+\}", lambda found: IN_PATHS.get(found[0], "x"), path)


def test_the_table_names_every_route() -> None:
    there = [route for router in centre_app.ROUTERS for route in router.routes]
    named = {
        (method, filled(route.path))
        for route in [*there, *centre_app.shared()]
        if isinstance(route, APIRoute)
        for method in route.methods
    }
    assert named == {(method, path) for method, path, _, _ in ROWS}
    assert {route.path for route in centre_app.shared()} == set(centre_app.SHARED)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Centre]:
    yield from run_centre(tmp_path_factory.mktemp("scopes"))


@pytest.fixture(scope="module")
def tokens(shared: Centre) -> dict[str, str]:
    with shared.client() as http:
        read = http.post("/v1/tokens", json={"name": "reader", "scopes": ["read-model"]}).json()["token"]
    return {"reader": read, "rig": shared.key("Ward 9"), "administrator": TOKEN}


@pytest.mark.parametrize(("method", "path", "who", "status"), ROWS, ids=[f"{row[0]} {row[1]}" for row in ROWS])
def test_each_holder_gets_what_the_table_says(
    shared: Centre, tokens: dict[str, str], method: str, path: str, who: str, status: str
) -> None:
    expected = dict.fromkeys(HOLDERS, "401")
    if who == "rig":
        expected["rig"] = status
    else:
        expected["reader"] = status if who in ("reader", "anyone", "anybody", "page") else "403"
        expected["administrator"] = status
    if who in ("anybody", "page"):  # a page for whoever has no session is the way to sign in
        expected = dict.fromkeys(HOLDERS, status)
    found = {}
    with shared.client(None) as http:
        for number, holder in enumerate(HOLDERS):
            head = {"Authorization": f"Bearer {tokens[holder]}"} if holder in tokens else {}
            head["X-Forwarded-For"] = f"10.0.{number}.{ROWS.index((method, path, who, status))}"
            form = {"data": {"name": holder}} if path == "/sign-in" else {}
            code = http.request(method, path, headers=head, **form).status_code
            found[holder] = "4xx" if status == "4xx" and 400 <= code < 500 else str(code)
    assert found == expected


def test_forms_of_another_page_change_nothing(shared: Centre) -> None:
    with shared.client(None) as page:
        assert page.post("/sign-in", data={"token": TOKEN}).status_code == 303
        for method, path, who, _ in ROWS:
            if method != "GET" and who not in ("anybody", "rig"):
                answer = page.request(method, path)
                assert (answer.status_code, answer.json()["type"]) == (403, "/problems/csrf"), (method, path)


@contextmanager
def signed_in(centre: Centre) -> Iterator[httpx.Client]:
    with centre.client(None) as client:
        client.headers["Accept"] = "text/html"
        assert client.post("/sign-in", data={"token": TOKEN}).status_code == 303
        yield client


def csrf(page: str) -> str:
    return re.findall(r'name="csrf" value="([^"]+)"', page)[0]


def test_from_an_empty_page_to_a_rig_and_back(centre: Centre) -> None:
    with signed_in(centre) as page:
        first = page.get("/").text
        assert "No rig yet." in first and "Add one below" in first
        made = page.post("/rigs", data={"name": "Ward 3", "csrf": csrf(first)})
        key = re.findall(r"STIMRIG_CENTRE_KEY=(stimrig_rig_[\w-]+)", made.text)[0]
        assert f"STIMRIG_CENTRE_URL={centre.url}" in made.text
        assert key not in page.get("/").text, "it is shown this once"
        assert page.post("/rigs", data={"name": "Ward 3", "csrf": csrf(first)}).status_code == 409
        told = Teller()
        told.session()
        with centre.client(key) as rig:
            rig.post("/v1/rig/hello", json=told.hello("2026-03-02T08:00:00.000Z", state="latched", reason="stopped"))
            told.push(rig)
            rigs = page.get("/").text
            assert "latched" in rigs and "Clock off" in rigs and "0.1.0" in rigs
            warned = page.get("/warnings").text
            assert "The rig&#39;s clock is off" in warned and "s behind the centre" in warned
            number = re.findall(r'action="/warnings/(\d+)/acknowledge"', warned)[0]
            assert page.post(f"/warnings/{number}/acknowledge", data={"csrf": csrf(warned)}).status_code == 303
            assert "acknowledged by administrator" in page.get("/warnings").text
            assert page.post("/rigs/Ward 3/revoke", data={"csrf": csrf(first)}).status_code == 303
            assert rig.get("/v1/rig/files").status_code == 401
        assert "Revoked rigs (1)" in page.get("/").text


def test_a_participants_page_shows_sessions_of_all_rigs_newest_first_and_trends(centre: Centre) -> None:
    for number, name in enumerate(("Ward 1", "Ward 2")):
        told = Teller()
        for week in range(8):
            told.session(day=f"2026-0{1 + week // 4}-{1 + 7 * (week % 4) + number:02}", number=week)
        with centre.client(centre.key(name)) as rig:
            told.push(rig)
    with signed_in(centre) as page:
        text = page.get("/participants/P017").text
        assert "16 sessions, 16 recordings" in text
        assert "Threshold" in text and "<svg" in text and "(µs)" in text and "(N·m)" in text
        days = re.findall(r'id="s-([\d-]+)~(\d+)"', text)
        assert len(days) == 12 and days == sorted(days, reverse=True)
        earlier = re.findall(r'href="(/participants/P017\?before=[^"]+)"', text)[-1]
        more = re.findall(r'id="s-([\d-]+)~(\d+)"', page.get(earlier).text)
        assert len(more) == 4 and max(more) < min(days)
        link = re.findall(r'href="(/v1/recordings/\d+)"', text)[0]
        assert page.get(link).content.startswith(b"HDF5 of 2026-02-2")


def test_participants_are_found_by_code_rig_day_effect_and_verdict(centre: Centre, http: httpx.Client) -> None:
    for name, code, verdict, effects, day in (
        ("Ward 1", "P001", "usable", ["fatigue"], "2026-03-02"),
        ("Ward 1", "P002", "not usable", ["tremor"], "2026-03-09"),
        ("Ward 2", "P002", "usable", [], "2026-03-16"),
        ("Ward 2", "Q001", "usable with care", ["fatigue", "tremor"], "2026-04-01"),
    ):
        told = Teller()
        told.session(code, day, verdict=verdict, effects=effects)
        row = centre.row(name)
        with centre.client(centre.key(name) if row is None else again(centre, name)) as rig:
            told.push(rig)

    def found(**asked: str) -> list[str]:
        return [one["code"] for one in http.get("/v1/participants", params=asked).json()["participants"]]

    assert found() == ["P001", "P002", "Q001"]
    assert found(q="P") == ["P001", "P002"] and found(q="p") == [] and found(q="P%") == []
    assert found(rig="Ward 2") == ["P002", "Q001"]
    assert found(**{"from": "2026-03-09", "to": "2026-03-31"}) == ["P002"]
    assert found(effect="tremor") == ["P002", "Q001"] and found(effect="tremor", rig="Ward 1") == ["P002"]
    assert found(verdict="usable") == ["P001", "P002"] and found(verdict="usable", to="2026-03-05") == ["P001"]
    page = http.get("/v1/participants", params={"limit": 2}).json()
    assert page["after"] == "P002" and found(after="P002") == ["Q001"]
    assert page["participants"][1]["rigs"] == ["Ward 1", "Ward 2"]
    for wrong in ({"from": "yesterday"}, {"verdict": "nice"}, {"effect": "'"}, {"after": "a b"}):
        assert http.get("/v1/participants", params=wrong).status_code == 422
    assert http.get("/v1/participants", params={"rig": "Ward 8"}).status_code == 404


def again(centre: Centre, name: str) -> str:
    """Another key for a rig that is there."""
    with centre.client() as http:
        http.delete(f"/v1/rigs/{name}")
    return centre.key(name)


def test_recordings_are_listed_in_pages_by_key(centre: Centre, rig: httpx.Client, http: httpx.Client) -> None:
    told = Teller()
    for number in range(7):
        told.session(f"P{number % 2}", f"2026-03-0{1 + number}", number)
    told.push(rig)
    seen, after = [], None
    while True:
        asked = {"limit": 3, **({"after": after} if after else {})}
        page = http.get("/v1/recordings", params=asked).json()
        seen += [one["created_utc"][:10] for one in page["recordings"]]
        after = page["after"]
        if after is None:
            break
    assert seen == [f"2026-03-0{day}" for day in range(1, 8)]

    def days(**asked: str) -> list[str]:
        return [one["created_utc"][8:10] for one in http.get("/v1/recordings", params=asked).json()["recordings"]]

    assert days(participant="P1") == ["02", "04", "06"]
    assert days(**{"from": "2026-03-03", "to": "2026-03-05"}) == ["03", "04", "05"]
    assert days(participant="P0", rig="Ward 1", to="2026-03-03T08:00:00.000Z") == ["01"]
    for wrong in ({"after": "x"}, {"after": "2026-03-01T08:00:00.000Z~x"}, {"from": "1"}, {"participant": "a b"}):
        assert http.get("/v1/recordings", params=wrong).status_code == 422
    assert http.get("/v1/recordings", params={"rig": "Ward 8"}).status_code == 404


def test_a_hostile_rig_breaks_nothing_and_nothing_of_it_is_run(centre: Centre, rig: httpx.Client, http: httpx.Client):
    deep: object = "x"
    for _ in range(30):
        deep = [deep]
    told = Teller(after={"chain": "<script>boom()</script>", "seq": 10**30})
    for number, text in enumerate(HOSTILE):
        told.add("participant", text, {"code": text, "side": text, "muscle": text})
        told.add("participant", f"P{number}", {"code": f"P{number}", "side": text, "muscle": text, "more": deep})
        odd = {"participant": f"P{number}", "created_utc": text, "requested_utc": text, "reason": text, "kind": text}
        told.add("test", text, {**odd, "state": text, "finished_utc": text})
        told.add("recording", text, {**odd, "origin": text, "test_id": text}, text.encode())
        fit = {"verdict": text, "words": text, "fit_percent": 10**400, "figures": {
            text: {"value": 1}, "threshold_us": {"value": 1e308, "sd": -1, "unit": text},
            "tremor.frequency_hz": {"value": "NaN", "sd": None, "unit": "<b>"}, "plateau_nm": deep,
            "damping": {"value": True, "sd": {}, "unit": 5},
        }}  # fmt: skip
        told.add("model", text, {**odd, "effects": [text, deep, 5], "fit": fit, "method": text}, b"{")
        told.add("decision", text, {**odd, "model_id": text, "approved": True, "by": text, "at_utc": text})
    for kind in ("participant", "test", "recording", "model", "decision", "tracked", "audit"):
        for body in ({}, {"participant": 5, "code": [], "fit": 7, "effects": {}, "seq": True}, {"seq": -(10**40)}):
            told.add(kind, "x" * 200, body)
    answer = rig.post("/v1/rig/items", content=json.dumps(told.batch()))
    assert answer.status_code == 200, answer.text
    assert (
        rig.post(
            "/v1/rig/hello",
            json=told.hello("<script>", version=HOSTILE[2], state=HOSTILE[2], reason=HOSTILE[3], damaged=HOSTILE),
        ).status_code
        == 200
    )
    for lacking in rig.get("/v1/rig/files").json()["files"]:
        sent = rig.put(f"/v1/rig/files/{lacking['sha256']}?offset=0", content=told.files[lacking["sha256"]])
        assert sent.status_code == 200
    with signed_in(centre) as page:
        addresses = ["/", "/warnings", "/participants", "/administration", *(f"/participants/P{n}" for n in range(5))]
        for address in addresses:
            shown = page.get(address)
            assert shown.status_code == 200, (address, shown.text)
            assert "<script>boom" not in shown.text and "\x00" not in shown.text and "\u202e" not in shown.text
            assert "script-src 'self'" in shown.headers["content-security-policy"]
    for one in http.get("/v1/recordings").json()["recordings"]:
        got = http.get(one["url"])
        assert got.status_code == 200 and re.fullmatch(
            r'attachment; filename="[A-Za-z0-9_.-]+"', got.headers["content-disposition"]
        )
    assert not list(Path(centre.data).glob("**/passwd"))
    assert http.get("/v1/participants").status_code == 200 and http.get("/metrics").status_code == 200


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"seq": 2**60}, 422), ({"seq": "1"}, 422), ({"seq": True}, 422), ({"kind": "Begin!"}, 422),
        ({"key": "x" * 201}, 422), ({"file_bytes": -1}, 422), ({"hash": "../"}, 422), ({"body": []}, 422),
        ({"body": {"a": "\ud800"}}, 422), ({"at_utc": "x" * 41}, 422),
    ],
)  # fmt: skip
def test_a_field_that_does_not_hold_is_named(rig: httpx.Client, change: dict[str, object], status: int) -> None:
    told = Teller()
    batch = {"chain": told.chain, "items": [{**told.items[0], **change}]}
    refused = rig.post("/v1/rig/items", content=json.dumps(batch))
    assert refused.status_code == status, refused.text
    assert "\n" not in refused.json()["detail"]


def test_a_rig_at_work_is_no_rig_to_look_at() -> None:
    fine = set(get_args(RigState)) - {"disconnected", "uncertain", "latched"}
    for state in [*get_args(RigState), "unreachable", "silent", "of a newer rig"]:
        assert ("state" in doubts(CentreRig(state=state), 0.0)) == (state not in fine), state


@pytest.mark.parametrize("label", ["9999-12-31T23:59:59Z", "9999-12-30T00:00:00.000Z"])
def test_a_day_after_which_there_is_none_is_no_day(
    centre: Centre, rig: httpx.Client, http: httpx.Client, label: str, told: Teller
) -> None:
    told.add("recording", "r1", {"participant": "P1", "created_utc": label})
    told.add("test", "t1", {"participant": "P1", "requested_utc": label, "finished_utc": label, "plan": {}})
    assert rig.post("/v1/rig/items", json=told.batch()).status_code == 200
    assert rig.post("/v1/rig/hello", json=told.hello(label)).status_code == 200
    assert http.get("/participants/P1").status_code == 200
    assert http.get("/v1/participants/P1/sessions").json()["sessions"][0]["day"] < "9999"
