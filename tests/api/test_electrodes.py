"""Which electrode of an array: a search through the service and on its page; what is played, told, proposed, chosen."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from stimrig.api.sessions import electrodes
from stimrig.api.store.tables import Participant
from stimrig.identify.electrodes import PRESETS
from tests.api.conftest import REAL, Service, csrf, own_service, shared_service, signed_in, soon, wait_done

SWITCH = {"device": "fake switch", "channel": "biceps", "elements": 4}
LAID = {"rows": 2, "columns": 2, "pitch_mm": 12.0}
PERSON = "/v1/participants/P017"
PAGE = "/participants/P017/electrodes"
FORM = {"rows": "2", "columns": "2", "pitch_mm": "12", "width_us": "250", "current_ma": "18,5", "wish": "selective"}
shared = shared_service(REAL, speed=60.0)
stubbed = own_service(speed=60.0)


def fitted(service: Service, http: httpx.Client, **laid: Any) -> None:
    """The rig has a switch, which the service knows."""
    service.rig.channels, service.rig.switch = ["biceps"], {**SWITCH, **laid}
    service.rig.become("ready")
    soon(lambda: http.get("/v1/rig").json().get("switch") == service.rig.switch)


@pytest.fixture
def client(shared: Service, request: pytest.FixtureRequest) -> Iterator[httpx.Client]:
    """Of a new participant, at a rig with an array of four."""
    code = f"P{abs(hash(request.node.name)) % 10**9}"
    with shared.client() as http:
        fitted(shared, http)
        assert http.post("/v1/participants", json={"code": code, "side": "left"}).status_code == 201
        http.headers["X-Code"] = code
        yield http


def begin(http: httpx.Client, **more: Any) -> dict[str, Any]:
    code = http.headers["X-Code"]
    begun = http.post(f"/v1/participants/{code}/searches", json={**LAID, **more})
    assert begun.status_code == 201, begun.text
    assert begun.headers["location"] == f"/v1/searches/{begun.json()['id']}"
    return begun.json()


def play(http: httpx.Client, search: dict[str, Any], elements: list[int] | None = None) -> dict[str, Any]:
    """Play one to its end; the search after it."""
    begun = http.post(f"/v1/searches/{search['id']}/stimuli", json={"elements": elements})
    assert begun.status_code == 202, begun.text
    wait_done(http, begun.json()["stimuli"][-1]["test_id"])
    return http.get(f"/v1/searches/{search['id']}").json()


def tell(http: httpx.Client, search: dict[str, Any], spill: str = "none", comfort: float = 8.0) -> httpx.Response:
    body = {"test_id": search["stimuli"][-1]["test_id"], "spill": spill, "comfort": comfort}
    return http.post(f"/v1/searches/{search['id']}/seen", json=body)


def test_the_wishes_are_those_of_identify() -> None:
    assert {name: str(words) for name, words in electrodes.WISHES.items()} == {
        name: words for name, (words, _wish) in PRESETS.items()
    }


def test_a_placement_names_elements_and_is_read_again() -> None:
    assert electrodes.chosen_at(electrodes.words([5])) == [5]
    assert electrodes.chosen_at(electrodes.words([3, 12])) == [3, 12]
    assert electrodes.chosen_at("A") == electrodes.chosen_at(None) == electrodes.chosen_at("elements 1, 2") == []


def test_a_search_needs_a_switch_a_layout_and_limits(shared: Service, client: httpx.Client) -> None:
    at = f"/v1/participants/{client.headers['X-Code']}/searches"
    refused = client.post(at, json={})
    assert refused.status_code == 422 and "rows, columns, pitch_mm" in refused.json()["detail"]
    refused = client.post(at, json={**LAID, "rows": 3})
    assert refused.status_code == 422 and "3 × 2 are not the 4 elements" in refused.json()["detail"]
    refused = client.post(at, json={**LAID, "width_us": 301.0})
    assert refused.status_code == 422 and refused.json()["type"].endswith("wider-profile")
    fitted(shared, client, **LAID)
    assert client.post(at, json={"rows": 9}).json()["rows"] == 2, "what the rig file tells counts"
    shared.rig.switch = None
    shared.rig.become("ready")
    soon(lambda: not client.get("/v1/rig").json().get("switch"))
    refused = client.post(at, json=LAID)
    assert refused.status_code == 409 and refused.json()["type"].endswith("no-switch")


def test_a_stimulus_is_played_told_and_moves_the_map(shared: Service, client: httpx.Client) -> None:
    search = begin(client, width_us=240.0, current_ma=16.0)
    assert search["state"] == "open" and len(search["map"]) == 4 + 6 and search["sure"] is None
    assert search["proposal"]["elements"] in [one["elements"] for one in search["map"]]
    search = play(client, search, [3])
    plan = shared.rig.last_plan
    assert plan is not None and plan.channels is not None and plan.segments is not None
    (channel,) = plan.channels
    assert (channel.name, channel.elements, channel.profile.current_ma) == ("biceps", [3], 16.0)
    assert channel.max_pulse_width_us == 240.0 and plan.kind == "electrode"
    rest, stimulus = plan.segments
    widths = stimulus.settings["pulse_width_us"]
    assert rest.sequence == "rest" and len(widths) == 40 and widths == sorted(widths)
    assert max(widths) == widths[24] == 240.0 and widths[0] == 10.0, "within 0.6 s up, then held"
    assert search["waiting"] == search["stimuli"][0]["test_id"] and not search["playing"]
    again = client.post(f"/v1/searches/{search['id']}/stimuli", json={})
    assert again.status_code == 409 and again.json()["type"].endswith("not-told")
    assert client.post(f"/v1/searches/{search['id']}/seen",
                       json={"test_id": "T", "spill": "none", "comfort": 5.0}).status_code == 409  # fmt: skip
    after = tell(client, search, "slight", 6.0).json()
    (told,) = after["stimuli"]
    assert (told["spill"], told["comfort"], told["by"]) == ("slight", 6.0, "administrator")
    assert told["torque_nm"] > 0.5, "the rise of the recording"
    assert after["waiting"] is None and next(one for one in after["map"] if one["elements"] == [3])["stimulated"]
    expected = next(one for one in after["map"] if one["elements"] == [3])["torque_nm"]["mean"]
    assert abs(expected - told["torque_nm"]) < 0.5 * told["torque_nm"]
    assert tell(client, after).status_code == 409, "told once"
    assert client.get(f"/v1/tests/{told['test_id']}").json()["state"] == "completed", "it gives no model"


def test_a_stimulus_without_a_usable_recording_holds_nothing_up(shared: Service, client: httpx.Client) -> None:
    search = play(client, begin(client), [1])
    for path in shared.rig.data.glob(f"*{search['waiting']}*.h5"):
        path.write_bytes(b"nothing")
    assert tell(client, search).status_code == 422
    after = client.get(f"/v1/searches/{search['id']}").json()
    assert after["waiting"] is None and after["stimuli"][0]["torque_nm"] is None
    assert not any(one["stimulated"] for one in after["map"]), "it is no evidence"
    assert play(client, after, [1])["waiting"]


def test_the_wanted_direction_turns_the_torque(client: httpx.Client) -> None:
    search = play(client, begin(client, direction="extension"), [1])
    assert tell(client, search).json()["stimuli"][0]["torque_nm"] < -0.5


def test_a_stopped_stimulus_is_no_evidence_and_not_proposed_again(shared: Service, client: httpx.Client) -> None:
    search = begin(client)
    proposed = search["proposal"]["elements"]
    shared.rig.speed = 0.1
    try:
        begun = client.post(f"/v1/searches/{search['id']}/stimuli", json={}).json()
        assert begun["playing"]
        assert client.post("/v1/stop", json={"reason": "pain"}).status_code == 200
        wait_done(client, begun["stimuli"][0]["test_id"])
    finally:
        shared.rig.speed = 60.0
    after = client.get(f"/v1/searches/{search['id']}").json()
    assert after["stimuli"][0]["state"] == "stopped" and after["waiting"] is None
    assert after["left_out"] == [proposed] and after["proposal"]["elements"] != proposed
    assert tell(client, after).status_code == 409
    latched = client.post(f"/v1/searches/{search['id']}/stimuli", json={})
    assert latched.status_code in (409, 503), "a stop is a stop"
    assert client.post("/v1/rearm").is_success


def test_the_next_stimulus_waits_for_the_answer_even_while_the_last_one_plays(
    shared: Service, client: httpx.Client
) -> None:
    search = begin(client)
    begun = client.post(f"/v1/searches/{search['id']}/stimuli", json={"elements": [1]}).json()
    statuses = set[int]()
    for _ in range(40):
        statuses.add(client.post(f"/v1/searches/{search['id']}/stimuli", json={"elements": [4]}).status_code)
    wait_done(client, begun["stimuli"][0]["test_id"])
    assert statuses == {409}
    assert [one["elements"] for one in client.get(f"/v1/searches/{search['id']}").json()["stimuli"]] == [[1]]


def test_what_was_seen_before_an_answer_or_a_stop_plays_nothing(shared: Service, client: httpx.Client) -> None:
    search = begin(client)
    at = f"/v1/searches/{search['id']}"
    old = {"If-Match": client.get(at).headers["etag"]}
    tell(client, play(client, search, [1]), "strong", 0.0)
    refused = client.post(f"{at}/stimuli", json={"elements": [1]}, headers=old)
    assert refused.status_code == 409 and "tell stimulus" in refused.json()["detail"], refused.text
    old = {"If-Match": client.get(at).headers["etag"]}
    assert client.post("/v1/stop", json={"reason": "pain"}).status_code == 200
    assert client.post("/v1/rearm").is_success
    soon(lambda: client.get("/v1/rig").json()["state"] == "ready")
    refused = client.post(f"{at}/stimuli", json={"elements": [1]}, headers=old)
    assert refused.status_code == 409 and "re-arm" in refused.json()["detail"], refused.text


def test_a_search_of_another_channel_chooses_nothing(shared: Service, client: httpx.Client) -> None:
    search = begin(client)
    try:
        shared.rig.channels = ["biceps", "triceps"]
        shared.rig.switch = {**SWITCH, "channel": "triceps"}
        shared.rig.become("ready")
        soon(lambda: client.get("/v1/rig").json()["switch"]["channel"] == "triceps")
        assert client.post(f"/v1/searches/{search['id']}/choice", json={"elements": [2]}).status_code == 409
    finally:
        fitted(shared, client)


def test_narrower_limits_end_a_wider_search(client: httpx.Client) -> None:
    search, code = begin(client), client.headers["X-Code"]
    assert client.put(f"/v1/participants/{code}/profile", json={"current_ma": 9.0}).status_code == 200
    refused = client.post(f"/v1/searches/{search['id']}/stimuli", json={})
    assert refused.status_code == 422 and refused.json()["type"].endswith("wider-profile")


def test_the_choice_is_the_placement_and_the_next_search_knows(client: httpx.Client) -> None:
    code = client.headers["X-Code"]
    search = begin(client)
    search = tell(client, play(client, search, [2])).json()
    at = f"/v1/searches/{search['id']}/choice"
    assert client.post(at, json={"elements": [9]}).status_code == 422
    closed = client.post(at, json={"elements": [2]}).json()
    assert closed["state"] == "closed" and closed["chosen"] == [2] and closed["closed_by"] == "administrator"
    assert client.get(f"/v1/participants/{code}").json()["placement"] == "element 2"
    entry = client.get("/v1/audit").json()["entries"][-1]
    assert (entry["action"], entry["subject"], entry["detail"]["search"]) == ("set muscle", code, search["id"])
    assert client.post(f"/v1/searches/{search['id']}/stimuli", json={}).status_code == 409
    client.post(at, json={"elements": [2, 1]})
    assert client.get(f"/v1/participants/{code}").json()["placement"] == "elements 1 and 2", "undone by another one"
    second = begin(client)
    assert second["prior"] and not search["prior"]
    sd = {one["elements"][0]: one["torque_nm"]["sd"] for one in second["map"] if len(one["elements"]) == 1}
    assert sd[2] < min(sd[1], sd[3], sd[4]), "what was seen there makes it surer"
    listed = client.get(f"/v1/participants/{code}/searches").json()
    assert [one["id"] for one in listed] == [second["id"], search["id"]]


def test_other_tests_are_played_at_the_chosen_electrode(shared: Service, client: httpx.Client) -> None:
    code = client.headers["X-Code"]
    asked = {"participant": code, "segments": [{"name": "rest", "sequence": "rest"}]}
    refused = client.post("/v1/tests", json=asked)
    assert refused.status_code == 409 and refused.json()["type"].endswith("no-element"), refused.text
    for placement, elements in (("elements 1 and 3", [1, 3]), ("element 9", None)):
        site = {"side": "left", "muscle": "biceps brachii", "placement": placement}
        assert client.put(f"/v1/participants/{code}/muscle", json=site).status_code == 200
        answer = client.post("/v1/tests", json=asked)
        assert answer.status_code == (409 if elements is None else 202), answer.text
        if elements is not None:
            wait_done(client, answer.json()["id"])
            played: Any = shared.rig.last_plan
            assert [(one.name, one.elements) for one in played.channels] == [("biceps", elements)]


def test_a_calibration_at_another_electrode_ends_only_when_that_is_said(shared: Service, client: httpx.Client) -> None:
    code = client.headers["X-Code"]
    search = begin(client)
    site = {"side": "left", "muscle": "biceps brachii", "placement": "element 1"}
    assert client.put(f"/v1/participants/{code}/muscle", json=site).status_code == 200
    with shared.context.store.write() as session:
        person = session.get(Participant, code)
        assert person is not None
        person.profile = {**person.profile, "sensory_pulse_width_us": 60.0, "motor_pulse_width_us": 90.0}
    at = f"/v1/searches/{search['id']}/choice"
    assert client.post(at, json={"elements": [1]}).status_code == 200
    refused = client.post(at, json={"elements": [2]})
    assert refused.status_code == 409 and refused.json()["type"].endswith("voids-calibration")
    with shared.context.store.write() as session:
        session.get(Participant, code).placement = None  # pyright: ignore[reportOptionalMemberAccess]
    refused = client.post(at, json={"elements": [2]})
    assert refused.status_code == 409, "calibrated where no element was said"
    assert client.post(at, json={"elements": [2], "void_calibration": True}).status_code == 200
    assert client.get(f"/v1/participants/{code}").json()["profile"].get("motor_pulse_width_us") is None


def test_such_a_test_is_not_started_by_itself(client: httpx.Client) -> None:
    refused = client.post("/v1/tests", json={"participant": client.headers["X-Code"], "kind": "electrode"})
    assert refused.status_code == 422 and refused.json()["type"].endswith("of-a-search")


# ---- the page -----------------------------------------------------------------------------------------------------


def sent(tab: httpx.Client, path: str, **fields: str) -> httpx.Response:
    html = tab.get(PAGE).text
    seen = re.findall(r'name="seen" value="([^"]+)"', html)[0]
    return tab.post(path, data={"csrf": csrf(tab), "seen": seen, **fields})


def test_the_page_leads_from_the_wish_to_the_choice(stubbed: Service) -> None:
    with signed_in(stubbed) as tab, stubbed.client() as http:
        assert http.post("/v1/participants", json={"code": "P017"}).status_code == 201
        assert "This rig has no electrode array" in tab.get(PAGE).text
        assert "/electrodes" not in tab.get("/participants/P017").text
        fitted(stubbed, http)
        assert "/participants/P017/electrodes" in tab.get("/participants/P017").text
        html = tab.get(PAGE).text
        assert "a slight spill-over costs more than half" in html and 'name="pitch_mm"' in html
        wrong = sent(tab, PAGE, **{**FORM, "width_us": "250 µs"})
        assert wrong.status_code == 422 and 'id="width_us-error"' in wrong.text
        assert sent(tab, PAGE, **FORM).status_code == 303
        html = tab.get(PAGE).text
        assert "Play 1: 250 µs, 18.5 mA" in html and html.count("<circle") >= 8 and "data-stop-keys" in html
        search = http.get(f"{PERSON}/searches").json()[0]
        at = f"{PAGE}/{search['id']}"
        wrong = sent(tab, f"{at}/stimuli", typed="elf")
        assert wrong.status_code == 422 and "Type one element or a pair" in wrong.text and 'id="play"' in wrong.text
        assert sent(tab, f"{at}/stimuli", elements="1").status_code == 303
        test_id = http.get(f"/v1/searches/{search['id']}").json()["stimuli"][0]["test_id"]
        wait_done(http, test_id)
        html = tab.get(PAGE).text
        assert "What did 1 give?" in html and html.count('name="comfort"') == 11
        assert sent(tab, f"{at}/seen", test_id=test_id, spill="slight").status_code == 422
        assert sent(tab, f"{at}/seen", test_id=test_id, spill="slight", comfort="7").status_code == 303
        html = tab.get(PAGE).text
        assert re.search(r"1 stimulus; it is 83.% sure that the best so far is within 10 % of the best\.", html)
        assert "1 is good: use it" in html
        assert sent(tab, f"{at}/choice", elements="1+2").status_code == 303
        assert http.get(PERSON).json()["placement"] == "elements 1 and 2"
        assert http.post("/v1/participants", json={"code": "P018"}).status_code == 201
        seen = re.findall(r'name="seen" value="([^"]+)"', tab.get(PAGE.replace("P017", "P018")).text)[0]
        form = {"csrf": csrf(tab), "seen": seen, "elements": "1"}
        for deed in ("stimuli", "choice"):
            other = tab.post(f"{at.replace('P017', 'P018')}/{deed}", data=form)
            assert other.status_code == 404, "a search is its participant's"
        assert "1+2 is used" in tab.get(PAGE).text and 'name="wish"' in tab.get(f"{PAGE}?anew=1").text
