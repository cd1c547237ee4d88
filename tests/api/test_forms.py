"""Limits typed by a person, and the page that is read before current flows: exactly that starts, once, and soon."""

from __future__ import annotations

import concurrent.futures
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api.sessions.previews import CAPACITY_OF_ONE, VALID_S
from stimrig.api.store.tables import Participant
from stimrig.api.web.pages.limits_form import number_text
from tests.api import fake_rig
from tests.api.conftest import Service, SetClock, run_test, signed_in, wait_done
from tests.api.forms import find, press
from tests.api.test_problems import problem
from tests.api.test_profiles import calibrate, limits

PAGE = "/participants/P017"
LIMITS, CALIBRATE = "/profile", "/calibration"
TEMPLATES = Path(__file__).parents[2] / "api" / "web" / "pages" / "templates"


@pytest.fixture
def tab(service: Service, participant: str) -> Iterator[httpx.Client]:
    with signed_in(service) as browser:
        yield browser


def send(tab: httpx.Client, html: str = "", confirm: str = "", **limits: float) -> httpx.Response:
    return press(tab, PAGE, LIMITS, html=html, confirm=confirm, **limits)


# ---- numbers ------------------------------------------------------------------------------------------------

TAKEN = {"9": 9.0, "9,5": 9.5, "9.5": 9.5, "0,5": 0.5, " 12.25 ": 12.25, "300": 300.0, "−5": -5.0}
REFUSED = [
    "1.234,5", "1,234.5", "1 234", "1,234", "1.234", "9,5,1", "9..5", "1e3", "٩", "９", "9٫5", "+9", "9 mA", "9,",
    ",5", "09,5", "0x10", "1_0", "nan", "inf", "true", "9\u00a05", "⁹", "½", "9'5", "123456", "=9",
]  # fmt: skip
READ = """(texts) => { const form = document.getElementById('limits'), field = form.elements.current_ma;
  return texts.map((text) => { field.value = text; const sent = act.read(form);
    return sent.errors.length ? sent.errors[0].message : sent.body.current_ma; }); }"""


@pytest.mark.browser
def test_comma_and_point_mean_the_decimal_sign_and_what_could_mean_two_things_is_refused(
    browser: object, service: Service, participant: str
) -> None:
    from tests.api.browser import open_tab

    for page in open_tab(browser, service):
        page.goto(service.url + PAGE)
        assert page.evaluate(READ, list(TAKEN)) == list(TAKEN.values())
        for text, said in zip(REFUSED, page.evaluate(READ, REFUSED), strict=True):
            assert isinstance(said, str) and "like 9 or 9,5 or 9.5" in said and text.strip() in said, text
        page.locator("#current_ma").fill("9,5,1")
        page.get_by_role("button", name="Set the limits").click()
        page.locator("#current_ma-error", has_text="9,5,1").wait_for()
        assert page.locator("#current_ma").input_value() == "9,5,1"
        assert not [url for url in page.requests if url.endswith("/profile")], "nothing was sent"


@given(st.floats(0, 500, exclude_min=True))
def test_a_field_shows_exactly_what_is_saved(value: float) -> None:
    assert float(number_text(value)) == value and not re.search("[^0-9.]", number_text(value))


def test_no_field_of_a_person_is_read_by_the_browsers_own_rules() -> None:
    """<input type=number> shows and posts by the browser's language, and throws away what it does not take."""
    texts = {path.name: path.read_text("utf-8") for path in TEMPLATES.glob("*.html")}
    assert texts and not [name for name, text in texts.items() if re.search(r'(?<!data-)type="number"', text)]


def test_every_button_that_stimulates_looks_like_it() -> None:
    """One class for all of them, and no other button has it."""
    texts = {path.name: path.read_text("utf-8") for path in TEMPLATES.glob("*.html")}
    found = [name for name, text in texts.items() for _ in re.findall(r'<button[^>]*class="[^"]*stimulate', text)]
    pages = ("calibration", "model", "next", "participant", "start", "trials")
    assert sorted(found) == [f"{name}.html" for name in pages]


# ---- limits -------------------------------------------------------------------------------------------------


def test_only_what_was_typed_is_set(tab: httpx.Client, client: httpx.Client) -> None:
    client.put("/v1/participants/P017/profile", json={"current_ma": 9.1234567})
    form, _, _ = find(tab.get(PAGE).text, LIMITS)
    assert next(field.value for field in form.fields if field.name == "current_ma") == 9.1234567
    assert send(tab, max_torque_nm=25).status_code == 200
    assert limits(client) == {"current_ma": 9.1234567, "max_pulse_width_us": 300, "max_torque_nm": 25}


def test_bounds_are_this_rigs_own_and_said_at_the_field(tab: httpx.Client, client: httpx.Client) -> None:
    page = tab.get(PAGE).text
    assert "at most 60 mA (rig file)" in page and "at most 500 µs (hard limit)" in page
    for sent, field, words in (
        ({"current_ma": 60.5}, "current_ma", "at most 60 mA, as this rig asks (rig file)"),
        ({"max_pulse_width_us": 5000}, "max_pulse_width_us", "less than or equal to 500"),
        ({"current_ma": 60, "max_pulse_width_us": 400}, "max_pulse_width_us", "20 µC that this rig takes"),
    ):
        (error,) = problem(send(tab, **sent), 422)["errors"]
        assert error["field"] == field and words in error["detail"]
    assert limits(client)["current_ma"] == 20


def test_a_jump_is_asked_about_and_the_answer_holds_for_exactly_that(tab: httpx.Client, client: httpx.Client) -> None:
    asked = problem(send(tab, current_ma=25.5), 409)["confirm"]
    assert asked["warnings"] == ["The current rises from 20 to 25.5 mA, 1.27 times as much."]
    assert asked["button"] == "Yes, set 25.5 mA, 300 µs, 30 N·m" and asked["rows"][0]["before"] == "20 mA"
    assert limits(client)["current_ma"] == 20, "nothing yet"
    assert send(tab, current_ma=59, confirm=asked["token"]).status_code == 409, "another question"
    assert send(tab, current_ma=25.5, confirm=asked["token"]).status_code == 200
    assert limits(client) == {"current_ma": 25.5, "max_pulse_width_us": 300, "max_torque_nm": 30}
    assert send(tab, current_ma=31).status_code == 200, "not more than a quarter"


def test_a_yes_to_old_limits_changes_nothing(tab: httpx.Client, client: httpx.Client) -> None:
    html = tab.get(PAGE).text
    token = problem(send(tab, html=html, current_ma=40), 409)["confirm"]["token"]
    client.put("/v1/participants/P017/profile", json={"current_ma": 10})
    assert send(tab, html=html, current_ma=40, confirm=token).status_code == 412
    assert send(tab, current_ma=40, confirm=token).status_code == 409, "it is asked about 10 to 40 mA now"
    assert limits(client)["current_ma"] == 10


# ---- calibration --------------------------------------------------------------------------------------------


def test_a_calibration_far_above_the_participants_current_is_asked_about(tab: httpx.Client, service: Service) -> None:
    page = f"{PAGE}/calibration"
    assert problem(press(tab, page, CALIBRATE, step_us=26), 422)["errors"][0]["field"] == "step_us"
    asked = problem(press(tab, page, CALIBRATE, current_ma=45), 409)["confirm"]
    assert "rises from 20 to 45 mA" in asked["warnings"][0] and service.rig.calibration is None
    assert press(tab, page, CALIBRATE, current_ma=45, confirm=asked["token"]).status_code == 201
    assert service.rig.calibration is not None and service.rig.calibration.current_ma == 45


# ---- Before current flows a person sees who, how much, how long, and presses: exactly that starts, once, and soon.


PAGE, WHERE = "/participants/P017", "/participants/P017/start"
START = "POST /v1/tests"


def rows(page: str) -> dict[str, str]:
    return dict(re.findall(r'<th scope="row">([^<]*)</th><td>(?:<b>)?([^<]*)', page))


def start(tab: httpx.Client, shown: str) -> httpx.Response:
    return press(tab, "", START, html=shown)


def test_the_page_shows_who_and_how_much_and_plays_nothing(tab: httpx.Client, client: httpx.Client, service: Service):
    client.put("/v1/participants/P017/muscle", json={"side": "right", "muscle": "triceps brachii"})
    page = tab.get(WHERE).text
    assert "Start the pre-session test of P017?" in page and "P017 is not calibrated" in page
    told = rows(page)
    assert (told["Who"], told["Current of every pulse"], told["How long"]) == ("P017", "20 mA", "25 s")
    assert told["Widest pulse"] == "300 µs, comfort maximum 300 µs" and told["Stops at"] == "30.0 N·m"
    assert re.fullmatch(r"\d+ pulses, \d\.\d\d.mC \(charge of one phase, all pulses together\)", told["Dose"])
    assert "FAKE P24" in told["Rig"] and told["Calibration"] == "not calibrated"
    assert (told["Side and muscle"], told["Run by"]) == ("right, triceps brachii", "administrator")
    assert re.search(r'class="stimulate big" data-needs-ready[^>]*>Start now: 20 mA, 300 µs<', page)
    assert service.rig.starts == 0 and service.context.runner.current is None
    calibrate(client)
    page = tab.get(WHERE).text
    assert "by administrator, valid until" in rows(page)["Calibration"] and "not calibrated" not in page


def test_it_starts_once_however_often_it_is_pressed(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    shown = tab.get(WHERE).text
    with concurrent.futures.ThreadPoolExecutor(5) as pool:
        (test_id,) = {answer.json()["id"] for answer in pool.map(lambda _: start(tab, shown), range(5))}
    assert service.rig.starts == 1
    wait_done(client, test_id)
    assert tab.get(WHERE).status_code == 200, "somebody else only looks at the same plan"
    assert start(tab, shown).json()["id"] == test_id and service.rig.starts == 1, "Back, and once more"


@pytest.mark.parametrize(("unix_s", "monotonic_s"), [(0, VALID_S + 1), (VALID_S + 1, 0), (-60, 10)])
def test_a_plan_may_be_started_for_five_minutes_by_either_clock(
    tab: httpx.Client, service: Service, unix_s: float, monotonic_s: float
) -> None:
    clock = service.context.runner.previews.clock = SetClock()
    shown = tab.get(WHERE).text
    clock.unix, clock.now_s = clock.unix + unix_s, clock.now_s + monotonic_s
    assert "Nothing was started" in problem(start(tab, shown), 410)["detail"] and service.rig.starts == 0
    clock.unix, clock.now_s = SetClock().unix + VALID_S, SetClock().now_s + VALID_S
    assert start(tab, shown).status_code == 202


def test_a_plan_is_of_one_participant_and_complete(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    client.post("/v1/participants", json={"code": "P018"})
    plan_hash = client.post("/v1/preview", json={"participant": "P017"}).json()["plan_hash"]
    asked = {"participant": "P017", "plan_hash": plan_hash}
    assert client.post("/v1/tests", json={**asked, "participant": "P018"}).status_code == 410
    assert client.post("/v1/tests", json={**asked, "plan_hash": "0" * 64}).status_code == 410
    refused = problem(client.post("/v1/tests", json={**asked, "pulse_rate_hz": 20.0}), 422)
    assert "all else is as it was previewed" in refused["detail"]
    assert tab.post("/v1/tests", json=asked).status_code == 403, "a start carries the session's CSRF token"
    assert service.rig.starts == 0
    for _ in range(CAPACITY_OF_ONE + 1):
        client.post("/v1/preview", json={"participant": "P018"})
    assert client.post("/v1/tests", json=asked).status_code == 202, "previews of others take no place of it"


@pytest.mark.parametrize(("what", "body"), [("profile", {"current_ma": 10}), ("muscle", {"side": "right"})])
def test_limits_changed_meanwhile_are_not_played(
    tab: httpx.Client, client: httpx.Client, service: Service, what: str, body: dict[str, Any]
) -> None:
    """Nor are they on a version that is read anew."""
    shown = tab.get(WHERE).text
    client.put(f"/v1/participants/P017/{what}", json=body)
    assert start(tab, shown).status_code == 412
    plan_hash = find(shown, START)[0].fields[1].value
    refused = client.post("/v1/tests", json={"participant": "P017", "plan_hash": plan_hash})
    assert "changed after the preview" in problem(refused, 409)["detail"]
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_set_up_anew_meanwhile_is_looked_at_again(
    tab: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = tab.get(WHERE).text
    widths, segments = fake_rig.default_widths()
    monkeypatch.setattr(fake_rig, "widths_of", lambda _plan: ([*widths, 300.0], segments))
    assert "would now play something else" in problem(start(tab, shown), 409)["detail"]
    assert service.rig.starts == 0 and service.context.runner.current is None


def test_a_rig_that_asks_for_a_calibration_offers_that_first(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    service.rig.require_calibration = True
    service.run(service.context.rig.fresh_status())
    page = tab.get(PAGE).text
    assert "Calibrate first" in page and "Start the pre-session test" not in page
    for query in ("", f"?kind=next-experiment&model={model}"):
        refused = tab.get(WHERE + query)
        assert refused.status_code == 409 and "Calibrate first" in refused.text
    calibrate(client)
    assert "Start the pre-session test" in tab.get(PAGE).text and "Start now" in tab.get(WHERE).text
    service.change(Participant, "P017", profile=lambda old: old | {"expires_at_utc": "2026-01-02T00:00:00Z"})
    assert "expired" in tab.get(PAGE).text and tab.get(WHERE).status_code == 409, "one of yesterday"


def test_no_experiment_is_played_that_could_not_be_joined(tab: httpx.Client, client: httpx.Client, service: Service):
    model = client.post("/v1/participants/P017/recordings", content=b"x").json()["model"]["id"]
    client.get(f"/v1/models/{model}/diagnosis")
    shown = tab.get(f"/models/{model}").text
    assert "Run it now" not in shown and "does not say with what current it was made" in shown
    assert tab.get(f"{WHERE}?kind=next-experiment&model={model}").status_code == 409
    assert client.post("/v1/tests", json={"participant": "P017", "joins": model}).json()["type"].endswith("current")
    assert service.rig.starts == 0


def test_the_next_experiment_is_shown_the_same_way(tab: httpx.Client, client: httpx.Client, service: Service):
    model = run_test(client, "P017")["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    assert re.search(r'<button class="stimulate big"[^>]*>Run it now', tab.get(f"/models/{model}").text)
    shown = tab.get(f"{WHERE}?kind=next-experiment&model={model}").text
    assert "Start the next experiment of P017?" in shown and f'href="/models/{model}"' in shown
    assert service.rig.starts == 1
    begun = start(tab, shown).json()["id"]
    assert service.rig.starts == 2 and wait_done(client, begun)["joins"] == model


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("kind=polka", "is no test that a page starts"), ("kind=adaptive&target=99", "less than or equal to 50"),
        ("kind=next-experiment&model=M-none", "There is no model"), ("kind=adaptive&target=x", "valid number"),
    ],
)  # fmt: skip
def test_an_address_of_no_test_is_refused_in_words(tab: httpx.Client, query: str, words: str) -> None:
    answer = tab.get(f"{WHERE}?{query}")
    assert answer.status_code in (404, 422) and words in answer.text
