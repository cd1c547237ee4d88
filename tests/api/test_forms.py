"""Limits typed by a person: decimal commas, slips of the keyboard, somebody quicker; nothing is lost unsaid."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api.web.pages.limits_form import number_text
from tests.api.conftest import Service, signed_in
from tests.api.forms import find, press
from tests.api.test_problems import problem
from tests.api.test_profiles import limits

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
