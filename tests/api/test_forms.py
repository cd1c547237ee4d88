"""Limits typed by a person: decimal commas, slips of the keyboard, somebody quicker; nothing is lost unsaid."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api.web.pages import typed
from tests.api.conftest import Service, csrf, signed_in
from tests.api.test_profiles import calibrate, limits

PAGE = "/participants/P017"
PAGES = Path(__file__).parents[2] / "api" / "web" / "pages"


@pytest.fixture
def tab(service: Service, participant: str) -> Iterator[httpx.Client]:
    with signed_in(service) as browser:
        yield browser


def fields(tab: httpx.Client, page: str = PAGE) -> dict[str, str]:
    """What a browser would send of the page's form as it stands."""
    return inputs(tab.get(page).text, page)


def inputs(html: str, page: str = PAGE) -> dict[str, str]:
    mine = [part for part in html.split("<form")[1:] if f'action="{page}' in part.split(">")[0]]
    form = next((part for part in mine if "<label" in part.split("</form>")[0]), mine[0])  # the one that is typed into
    tags = [tag for tag in re.findall(r"<input[^>]*>", form.split("</form>")[0]) if _sent(tag)]
    found = [re.search(r'name="([^"]*)".*value="([^"]*)"', tag) for tag in tags]
    return {match[1]: match[2] for match in found if match}


def _sent(tag: str) -> bool:
    """Of choices only the chosen one."""
    return not re.search(r'type="(radio|checkbox)"', tag) or " checked" in tag


def send(tab: httpx.Client, path: str = f"{PAGE}/profile", **typed_texts: str) -> httpx.Response:
    return tab.post(path, data={**fields(tab), **typed_texts})


def yes(tab: httpx.Client, asked: httpx.Response) -> httpx.Response:
    assert asked.status_code == 303 and "/confirm/" in asked.headers["location"], asked.text
    return tab.post(asked.headers["location"], data={"csrf": csrf(tab)})


# ---- numbers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [("9", 9.0), ("9,5", 9.5), ("9.5", 9.5), ("0,5", 0.5), (" 12.25 ", 12.25), ("300", 300.0), ("20,00", 20.0)],
)
def test_comma_and_point_mean_the_decimal_sign(text: str, value: float) -> None:
    assert typed.number(text) == value


REFUSED = [
    "1.234,5", "1,234.5", "1 234", "1,234", "1.234", "9,5,1", "9..5", "1e3", "٩", "９", "9٫5", "+9", "-9", "9 mA", "9,",
    ",5", "09,5", "0x10", "1_0", "nan", "inf", "true", "", "   ", "9\u00a05", "⁹", "½", "9'5", "123456", "=9",
]  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_what_could_mean_two_things_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"like 9 or 9,5 or 9\.5") as caught:
        typed.number(text)
    assert "\n" not in str(caught.value) and (repr(text.strip()) in str(caught.value) or not text.strip())


@given(st.one_of(st.text(), st.from_regex(r"[0-9.,]{1,8}"), st.floats().map(str)))
def test_whatever_is_typed_is_refused_or_what_a_person_reads(text: str) -> None:
    try:
        value = typed.number(text)
    except ValueError:
        return
    assert text.strip().isascii() and value == float(text.strip().replace(",", ".")) and 0 <= value < 1e5


def test_a_whole_number_is_one() -> None:
    assert [typed.whole(text) for text in ("30", " 7 ", "3,5", "1.5", "٣", "1e2", "-1", "")] == [30, 7, *[None] * 6]


@given(st.floats(0, 500, exclude_min=True))
def test_a_field_shows_exactly_what_is_saved(value: float) -> None:
    assert float(typed.number_text(value)) == value and not re.search("[^0-9.]", typed.number_text(value))


def test_no_field_of_a_person_is_read_by_the_browsers_own_rules() -> None:
    """<input type=number> shows and posts by the browser's language, and throws away what it does not take."""
    for path in PAGES.glob("templates/*.html"):
        for tag in re.findall(r'<input[^>]*type="number"[^>]*>', path.read_text("utf-8")):
            raise AssertionError((path.name, tag))
    assert 'type="text" inputmode="decimal"' in (PAGES / "templates" / "typed.html").read_text("utf-8")


# ---- the form -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["9,5", "9.5"])
def test_nine_and_a_half_is_no_ninety_five(tab: httpx.Client, client: httpx.Client, text: str) -> None:
    assert send(tab, current_ma=text).status_code == 303
    assert limits(client) == {"current_ma": 9.5, "max_pulse_width_us": 300, "max_torque_nm": 30}


def test_what_was_typed_is_kept_with_a_line_beside_it_and_nothing_happens(
    tab: httpx.Client, client: httpx.Client, service: Service
) -> None:
    before = limits(client)
    for path, text in itertools.product((f"{PAGE}/profile", f"{PAGE}/tests"), ("9,5,1", "1e3", "9٫5", "", "95.000")):
        refused = send(tab, path, current_ma=text, max_torque_nm="25")
        assert refused.status_code == 422 and "Nothing was changed" in refused.text, (path, text)
        assert inputs(refused.text)["current_ma"] == text and inputs(refused.text)["max_torque_nm"] == "25"
        line = re.search(r'id="current_ma-error">([^<]*)<', refused.text)
        assert line and "like 9 or 9,5" in line[1] and (text in line[1] or not text)
    assert limits(client) == before and service.rig.starts == 0


def test_a_name_is_refused_politely(tab: httpx.Client) -> None:
    refused = tab.post("/participants", data={"csrf": csrf(tab), "code": "Anna Schmidt"})
    assert refused.status_code == 422 and "Please no names" in refused.text


def test_bounds_are_this_rigs_own(tab: httpx.Client, client: httpx.Client) -> None:
    page = tab.get(PAGE).text
    assert "at most 60 mA (rig file)" in page and "at most 500 µs (hard limit)" in page
    refused = send(tab, current_ma="60,5")
    assert refused.status_code == 422 and "at most 60 mA, as this rig asks (rig file)" in refused.text
    assert "above this rig" not in refused.text
    wide = send(tab, max_pulse_width_us="5000")
    assert "&#39;5000&#39;: 5000 µs" in wide.text and inputs(wide.text)["max_pulse_width_us"] == "5000"
    charged = send(tab, current_ma="60", max_pulse_width_us="400")
    assert charged.status_code == 422 and "above the 20 µC that this rig takes" in charged.text
    assert limits(client)["current_ma"] == 20


def test_a_jump_asks_again_and_does_exactly_what_it_showed(tab: httpx.Client, client: httpx.Client) -> None:
    asked = send(tab, current_ma="25,5")
    page = tab.get(asked.headers["location"]).text
    assert "rises from 20 to 25.5 mA, 1.27 times as much" in page and "Yes, set 25.5 mA, 300 µs, 30 N·m" in page
    assert limits(client)["current_ma"] == 20, "nothing yet"
    done = tab.post(asked.headers["location"], data={"csrf": csrf(tab), "current_ma": "59", "max_torque_nm": "59"})
    assert done.headers["location"] == PAGE
    assert limits(client) == {"current_ma": 25.5, "max_pulse_width_us": 300, "max_torque_nm": 30}
    assert send(tab, current_ma="31").headers["location"] == PAGE, "not more than a quarter"


def test_a_yes_said_twice_or_to_old_limits_changes_nothing(tab: httpx.Client, client: httpx.Client) -> None:
    asked = send(tab, current_ma="40")
    assert yes(tab, asked).headers["location"] == PAGE
    client.put("/v1/participants/P017/profile", json={"current_ma": 10})
    assert yes(tab, asked).headers["location"] == PAGE
    assert limits(client)["current_ma"] == 10
    asked = send(tab, current_ma="40")
    client.put("/v1/participants/P017/profile", json={"current_ma": 11})
    assert yes(tab, asked).status_code == 409
    assert limits(client)["current_ma"] == 11


def test_limits_that_were_typed_go_with_start(tab: httpx.Client, client: httpx.Client, service: Service) -> None:
    """Typed, not saved, *Start* pressed: they are set on the way, and the question before current flows names them."""
    asked = send(tab, f"{PAGE}/tests", current_ma="9,5")
    page = tab.get(asked.headers["location"]).text
    assert "Start now: 9.5 mA, 300 µs" in page and limits(client)["current_ma"] == 9.5
    asked = send(tab, f"{PAGE}/tests", current_ma="19")
    assert "rises from 9.5 to 19 mA" in tab.get(asked.headers["location"]).text and service.rig.starts == 0
    asked = yes(tab, asked)
    page = tab.get(asked.headers["location"]).text
    assert "Start now: 19 mA, 300 µs" in page and limits(client)["current_ma"] == 19 and service.rig.starts == 0
    assert yes(tab, asked).headers["location"].startswith("/tests/"), "what was set on the way is not out of date"
    assert service.rig.last_plan.profile.current_ma == 19


def test_a_form_gone_stale_is_refused_with_both_values(tab: httpx.Client, client: httpx.Client) -> None:
    mine = fields(tab)
    client.put("/v1/participants/P017/profile", json={"current_ma": 9, "max_torque_nm": 20})
    for path in ("profile", "tests"):
        refused = tab.post(f"{PAGE}/{path}", data={**mine, "max_torque_nm": "25"})
        assert refused.status_code == 409
        assert re.search(r"<td>20 mA, 300 µs, 30 N·m<br>.*</td><td><b>9 mA, 300 µs, 20 N·m</b></td>", refused.text)
        assert '<span translate="no">administrator</span>' in refused.text
    again = inputs(refused.text, f"{PAGE}/tests")
    assert limits(client) == {"current_ma": 9, "max_pulse_width_us": 300, "max_torque_nm": 20}
    assert tab.post(f"{PAGE}/profile", data=again).status_code == 303
    now = limits(client)
    assert now["current_ma"] == 9, "only what was typed is set; the other's new current is not set back"
    assert now == {"current_ma": 9, "max_pulse_width_us": 300, "max_torque_nm": 25}


def test_a_field_sent_twice_is_refused(tab: httpx.Client, client: httpx.Client) -> None:
    body = "&".join([f"csrf={csrf(tab)}", "current_ma=9", "current_ma=19"])
    headers = {"content-type": "application/x-www-form-urlencoded"}
    assert tab.post(f"{PAGE}/profile", content=body, headers=headers).status_code == 422
    assert limits(client)["current_ma"] == 20


def test_saving_says_what_it_voids_and_keeps_what_it_can(tab: httpx.Client, client: httpx.Client) -> None:
    found = calibrate(client)
    assert send(tab, current_ma="18").headers["location"] == PAGE
    assert client.get("/v1/participants/P017").json()["profile"] == {**found, "current_ma": 18}
    asked = send(tab, current_ma="19")
    assert (
        "The calibration is lost with it: current 19 mA is above the 18 mA" in tab.get(asked.headers["location"]).text
    )
    assert client.get("/v1/participants/P017").json()["profile"]["motor_pulse_width_us"] == 20
    assert yes(tab, asked).headers["location"] == PAGE
    assert client.get("/v1/participants/P017").json()["profile"]["motor_pulse_width_us"] is None
    assert "Not calibrated" in tab.get(PAGE).text


def test_what_a_program_set_in_finer_steps_stays_as_it_is(tab: httpx.Client, client: httpx.Client) -> None:
    client.put("/v1/participants/P017/profile", json={"current_ma": 9.1234567})
    assert fields(tab)["current_ma"] == "9.1234567"
    assert send(tab, max_torque_nm="25").status_code == 303
    assert limits(client) == {"current_ma": 9.1234567, "max_pulse_width_us": 300, "max_torque_nm": 25}


# ---- calibration --------------------------------------------------------------------------------------------

BEGIN = f"{PAGE}/calibration"


def begin(tab: httpx.Client, **texts: str) -> httpx.Response:
    return tab.post(BEGIN, data={**fields(tab, BEGIN), **texts})


def test_a_calibration_begins_with_what_was_typed(tab: httpx.Client, service: Service) -> None:
    for texts in ({"current_ma": "1.234,5"}, {"current_ma": "61"}, {"step_us": "26"}, {"step_us": "0,5"}):
        refused = begin(tab, **texts)
        ((name, text),) = texts.items()
        assert refused.status_code == 422 and inputs(refused.text, BEGIN)[name] == text
        assert f'id="{ {"current_ma": "current", "step_us": "step"}[name] }-error"' in refused.text
    assert service.rig.calibration is None
    assert begin(tab, current_ma="9,5").headers["location"] == BEGIN
    assert service.rig.calibration is not None and service.rig.calibration.current_ma == 9.5


def test_a_calibration_far_above_the_participants_current_is_asked_about(tab: httpx.Client, service: Service) -> None:
    asked = begin(tab, current_ma="45")
    assert "rises from 20 to 45 mA" in tab.get(asked.headers["location"]).text
    assert service.rig.calibration is None
    assert yes(tab, asked).headers["location"] == BEGIN
    assert service.rig.calibration is not None and service.rig.calibration.current_ma == 45


def test_each_step_says_what_it_sends_and_sends_nothing_else(tab: httpx.Client, service: Service) -> None:
    begin(tab, current_ma="9,5")
    page = tab.get(BEGIN).text
    assert "Wider: 10 µs at 9.5 mA" in page and "disabled>Again<" in page
    assert service.rig.calibration is not None
    (version,) = set(re.findall(r'name="calibration" value="([^"]+)"', page))
    seen = {"csrf": csrf(tab), "calibration": version}
    assert tab.post(f"{BEGIN}/step/up", data=seen).status_code == 303
    assert "Wider: 20 µs at 9.5 mA" in tab.get(BEGIN).text
    late = tab.post(f"{BEGIN}/step/up", data=seen)
    assert late.status_code == 409 and "page is out of date" in late.text
    known = service.rig.calibration
    assert known is not None and [train.pulse_width_us for train in known.trains] == [10]


def test_every_button_that_stimulates_looks_like_it() -> None:
    """One class for all of them, and no other button has it."""
    with_class: dict[str, Any] = {}
    for path in PAGES.glob("templates/*.html"):
        count = len(re.findall(r"<button[^>]*class=\"[^\"]*stimulate", path.read_text("utf-8")))
        if count:
            with_class[path.name] = count
    assert with_class == {
        "next.html": 1, "participant.html": 1, "calibration.html": 1, "question.html": 1,
        "trials.html": 1, "experiment_form.html": 1,
    }  # fmt: skip
