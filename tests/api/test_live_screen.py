"""During a test: all of it on one screen, stopped by Esc or Space, and what a stopped test's page offers."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest

from stimrig.api.store.tables import Test
from stimrig.api.web.pages.views import limits_of
from stimrig.rig.messages import Bound, Status
from tests.api.browser import expected, participant, start
from tests.api.conftest import Service, shared_service, soon

pytestmark = pytest.mark.browser
SIZES = (1366, 768), (820, 1180)
"""A laptop and a tablet."""


service = shared_service(speed=0.7)


@pytest.fixture
def running(tab: Any, service: Service) -> Any:
    """The page of a test that runs for a while."""
    participant(tab, service, f"V{time.time_ns() % 10**9}")
    start(tab)
    tab.locator("#age", has_text="ms").wait_for()
    return tab


OUTSIDE = """(names) => { scrollTo(0, 0); return names.filter((name) => {
  const box = document.getElementById(name).getBoundingClientRect();
  return box.top < 0 || box.bottom > innerHeight; }); }"""


def test_everything_is_on_one_screen(running: Any) -> None:
    names = ["segment", "left", "torque", "width", "current", "dose", "age", "torque-chart", "width-chart", "tone"]
    for width, height in SIZES:
        running.set_viewport_size({"width": width, "height": height})
        soon(lambda: running.evaluate(OUTSIDE, names) == [], 8)  # the charts take the new size a moment later
        heights = [running.locator(f"#{name}-chart").bounding_box()["height"] for name in ("torque", "width")]
        assert heights[0] > 180 and heights[1] > 110, heights
        assert running.evaluate("document.documentElement.scrollWidth") <= width


LIMIT_PIXELS = """(id) => { const c = document.getElementById(id), pen = c.getContext('2d');
  const probe = document.createElement('canvas').getContext('2d');
  probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue('--limit'); probe.fillRect(0, 0, 1, 1);
  const [r, g, b] = probe.getImageData(0, 0, 1, 1).data, d = pen.getImageData(0, 0, c.width, c.height).data;
  let n = 0; for (let i = 0; i < d.length; i += 4)
    if (Math.abs(d[i] - r) + Math.abs(d[i + 1] - g) + Math.abs(d[i + 2] - b) < 60 && d[i + 3] > 100) n++;
  return n; }"""


def test_what_flows_is_told_in_numbers_and_a_clinicians_words(running: Any, service: Service) -> None:
    running.locator("#segment", has_text="Random pulses").wait_for(timeout=30_000)
    assert running.locator("#segment").get_attribute("title") == "prbs"
    assert running.locator("#current").inner_text() == "20.0 mA"
    expected(running.locator("#dose")).not_to_have_text(re.compile("^0 µC"))
    charge_uc, pulses = map(int, re.findall(r"(\d+) µC · (\d+) pulses", running.locator("#dose").inner_text())[0])
    assert charge_uc == 6 * pulses, "300 µs at 20 mA are 6 µC"
    assert "Check (not used for fitting)" in running.locator("#track").inner_text()
    for chart in ("torque-chart", "width-chart"):
        assert running.evaluate(LIMIT_PIXELS, chart) > 300, "the limits are lines in the charts"
    assert running.errors == []


def test_the_tightest_torque_limit_is_the_one_shown() -> None:
    profile = {"current_ma": 20.0, "max_torque_nm": 30.0, "max_pulse_width_us": 250.0}
    row = Test(plan={"profile": profile, "max_torque_nm": None, "max_pulse_width_us": 180.0})
    rig = Status(state="running", limits={"torque_nm": Bound(lo=-25, hi=25, unit="N·m", owner="rig file")})
    assert limits_of(row, rig) == {"current_ma": 20.0, "torque_nm": 25.0, "pulse_width_us": 180.0}
    row.plan["max_torque_nm"] = 12.0
    assert limits_of(row, rig)["torque_nm"] == limits_of(row, None)["torque_nm"] == 12.0


@pytest.mark.parametrize(("key", "focus"), [("Escape", "#tone"), (" ", ""), (" ", "#stop"), (" ", "#tone")])
def test_esc_and_space_stop_once_wherever_the_focus_is(running: Any, service: Service, key: str, focus: str) -> None:
    if focus:
        running.locator(focus).focus()
    sent: list[str] = []
    running.on("request", lambda request: sent.append(request.url) if request.method == "POST" else None)
    running.keyboard.press(key)
    running.get_by_text("The rig confirms that stimulation is off.").wait_for()
    assert [url.rsplit("/", 1)[1] for url in sent] == ["stop"]
    assert service.rig.stopped_by is not None


def test_a_space_in_a_note_is_a_space_and_esc_stops_there_too(running: Any, service: Service) -> None:
    running.evaluate(
        "document.querySelector('#live').insertAdjacentHTML('afterend', '<textarea id=remark></textarea>')"
    )
    running.locator("#remark").focus()
    running.keyboard.type("arm moved ")
    assert running.locator("#remark").input_value() == "arm moved " and service.rig.state == "running"
    running.keyboard.press("Escape")
    running.get_by_text("The rig confirms that stimulation is off.").wait_for()


def test_the_tone_is_off_until_it_is_wished_and_kept(running: Any) -> None:
    assert not running.locator("#tone").is_checked()
    running.locator("#tone").click()
    running.reload()
    expected(running.locator("#mute")).to_be_visible()
    assert running.locator("#tone").is_checked()
    running.mouse.click(5, 400)
    running.locator("#mute").wait_for(state="hidden")
    running.locator("#tone").click()
    running.reload()
    assert not running.locator("#tone").is_checked()


def test_a_page_that_was_signed_out_says_so_and_stops_all_the_same(running: Any, service: Service) -> None:
    expected(running.locator("#stale")).to_be_hidden()
    (cookie,) = running.context.cookies()
    service.app.state.context.auth.sign_out(cookie["value"])  # in another tab
    running.locator("#stale", has_text="You are signed out").wait_for(timeout=15_000)
    running.get_by_role("button", name="Stop stimulation").click()
    running.get_by_text("The rig confirms that stimulation is off.").wait_for()
