"""During a test: what its page tells, stopped by Esc or Space, and what a stopped test's page offers."""

from __future__ import annotations

import re
from base64 import b64encode
from math import nan
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.api.charts import model_charts
from stimrig.api.jobs.curves import recorded
from stimrig.api.sessions.live import frame_of
from stimrig.api.store.audit import digest
from stimrig.api.store.tables import PageSession, Test
from stimrig.api.web.pages.views import limits_of
from stimrig.identify.records import live
from stimrig.rig.messages import TORQUE_ROW, Bound, LiveEvent, PulseOutcomes, Status
from stimrig.rig.signals import SAMPLE
from tests.api.browser import enter, expected, participant, start
from tests.api.conftest import Service, shared_service, signed_in
from tests.api.test_stop_right import stops_noted

service = shared_service(speed=0.5)


LIMIT_PIXELS = """(id) => { const c = document.getElementById(id), pen = c.getContext('2d');
  const probe = document.createElement('canvas').getContext('2d');
  probe.fillStyle = colourOf('limit'); probe.fillRect(0, 0, 1, 1);
  const [r, g, b] = probe.getImageData(0, 0, 1, 1).data, d = pen.getImageData(0, 0, c.width, c.height).data;
  let n = 0; for (let i = 0; i < d.length; i += 4)
    if (Math.abs(d[i] - r) + Math.abs(d[i + 1] - g) + Math.abs(d[i + 2] - b) < 60 && d[i + 3] > 100) n++;
  return n; }"""


@pytest.mark.browser
def test_what_flows_is_told_and_esc_stops_also_where_a_space_is_a_space(tab: Any, service: Service) -> None:
    participant(tab, service, "V1")
    start(tab)
    tab.locator("#segment", has_text="Random pulses").wait_for()
    assert tab.locator("#segment").get_attribute("title") == "prbs"
    assert tab.locator("#current").inner_text() == "20.0 mA"
    expected(tab.locator("#dose")).not_to_have_text(re.compile("^0.00 mC"))
    charge_mc, pulses = map(float, re.findall(r"([\d.]+) mC · pulses: (\d+)", tab.locator("#dose").inner_text())[0])
    assert charge_mc == pytest.approx(0.006 * pulses, abs=0.005), "300 µs at 20 mA are 6 µC"
    assert "Check (not used for fitting)" in tab.locator("#track").inner_text()
    for chart in ("torque-chart", "width-chart"):
        assert tab.evaluate(LIMIT_PIXELS, chart) > 300, "the limits are lines in the charts"
    assert tab.errors == []
    tab.evaluate("document.querySelector('#live').insertAdjacentHTML('afterend', '<textarea id=remark></textarea>')")
    tab.locator("#remark").focus()
    tab.keyboard.type("arm moved ")
    assert tab.locator("#remark").input_value() == "arm moved " and service.rig.state == "running"
    tab.keyboard.press("Escape")
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()


TOLD_TWICE = """() => new Promise((done) => { let left = 2;
  addEventListener('rig-now', ({ detail }) => { if (detail.ended && !--left) done(); }); })"""
"""The page heard that its session has ended, and half a second later it is there to hear it again."""


@pytest.mark.browser
def test_the_end_of_a_session_takes_no_stop_key_away(tab: Any, service: Service) -> None:
    """The running test's page stays; the sign-in stops by Esc; a page whose stop waits for its answer stays."""

    def end_session() -> None:
        (cookie,) = tab.context.cookies()
        service.change(PageSession, digest(cookie["value"]), expires_unix_s=1.0)
        tab.evaluate(TOLD_TWICE)

    participant(tab, service, "V2")
    participant_page = tab.url
    start(tab)
    tab.locator("#segment", has_text="Random pulses").wait_for()
    running, stops = tab.url, service.rig.stops
    end_session()
    assert tab.url == running
    tab.goto(f"{service.url}/sign-in")
    tab.get_by_role("heading", name="Sign in").wait_for()
    tab.keyboard.press("Escape")
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()
    assert service.rig.stops == stops + 1

    enter(tab, service)
    tab.goto(participant_page)
    tab.route("**/v1/stop", lambda _route: None)  # its answer is long in coming
    tab.get_by_role("button", name="Stop stimulation").click()
    end_session()
    assert tab.url == participant_page


def test_the_tightest_torque_limit_is_the_one_shown() -> None:
    profile = {"current_ma": 20.0, "max_torque_nm": 30.0, "max_pulse_width_us": 250.0}
    row = Test(plan={"profile": profile, "max_torque_nm": None, "max_pulse_width_us": 180.0})
    rig = Status(state="running", limits={"torque_nm": Bound(lo=-25, hi=25, unit="N·m", owner="rig file")})
    assert limits_of(row, rig) == {"current_ma": 20.0, "torque_nm": 25.0, "pulse_width_us": 180.0}
    row.plan["max_torque_nm"] = 12.0
    assert limits_of(row, rig)["torque_nm"] == limits_of(row, None)["torque_nm"] == 12.0


# ---- A stopped test's page shows what was recorded, who stopped it and when; loading a stop's page again stops nothing


def stops(service: Service) -> int:
    with service.client() as http:
        return len(stops_noted(http))


@pytest.mark.browser
def test_a_stopped_tests_page_shows_what_was_recorded(tab: Any, service: Service) -> None:
    participant(tab, service, "W1")
    start(tab)
    tab.locator("#segment", has_text="Random pulses").wait_for()
    test_page, sent = tab.url, list[str]()
    tab.on("request", lambda request: sent.append(request.url) if request.method == "POST" else None)
    tab.keyboard.press(" ")
    tab.get_by_role("heading", name=re.compile(r"Stopped at \d\d:\d\d:\d\d")).wait_for()
    assert [url.rsplit("/", 1)[1] for url in sent] == ["stop"], "Space stops once"
    expected(tab.get_by_text("Ada: stop pressed on the page")).to_be_visible()
    assert "/stopped/" in tab.url
    tab.get_by_text("not initialised: switched off, as it is after each stop").wait_for()
    tab.get_by_role("button", name="I have checked: re-arm").wait_for()
    before = stops(service)
    with tab.expect_request(lambda request: request.is_navigation_request()) as asked:
        tab.reload()
    assert asked.value.method == "GET"
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()
    assert stops(service) == before, "loading the page again stops nothing again"
    tab.get_by_role("link", name="See what was recorded").click()
    tab.wait_for_url(test_page)
    tab.locator("#recorded svg.still").wait_for()
    tab.locator("#rig-state", has_text="Stopped").wait_for()
    shown = tab.locator("#recorded").inner_text()
    for words in ("torque, measured", "pulse width, sent", "planned, not played", "stopped at"):
        assert words in shown, words
    reason = tab.locator("#reason").inner_text()
    assert re.search(r"Stopped at \d\d:\d\d:\d\d, after \d+\.\d s\..*by Ada", reason), reason
    tab.locator("#rig-state", has_text="needs re-arm").wait_for()
    tab.get_by_role("button", name="I have checked: re-arm").click()
    tab.locator("#rig-state", has_text="ready").wait_for()
    assert tab.url == test_page and service.rig.state == "ready", "on the spot"
    assert tab.locator("canvas").count() == 0 and tab.get_by_text("What was planned", exact=True).count() == 0


def test_an_unconfirmed_stop_keeps_its_warning_when_loaded_again(service: Service) -> None:
    service.rig.confirms_stop = False
    with service.client() as http:
        answer = http.post("/v1/stop")
    assert (answer.status_code, answer.json()["title"]) == (503, "The stop is not confirmed")
    assert "emergency switch" in answer.json()["detail"]
    with signed_in(service) as browser:
        led = browser.post("/v1/stop", data={})
        assert led.status_code == 303
        for _ in range(2):
            told = browser.get(led.headers["location"])
            assert told.status_code == 503 and "emergency switch" in told.text
            assert "<h1>The stop is not confirmed" in told.text and "confirms" not in told.text
        unknown = browser.get("/stopped/none")  # as after a restart of the service
        assert unknown.status_code == 404 and "The bar above shows what the rig does now" in unknown.text
        assert 'id="rig-state"' in unknown.text and 'action="/v1/stop"' in unknown.text
    service.rig.confirms_stop = True
    with service.client() as http:
        http.post("/v1/rearm")


def made_up(path: Path, sent_us: list[float], seconds: float) -> Path:
    time_s = np.arange(int(400 * seconds)) / 400
    with h5py.File(path, "w") as file:
        file["torque/time_s"], file["torque/torque_nm"] = time_s, np.where(np.arange(time_s.size) == 777, 9.0, 1.0)
        file["pulses/planned_time_s"], file["pulses/sent_pulse_width_us"] = np.arange(len(sent_us)) / 40, sent_us
        file.create_dataset("segments/name", data=["prbs"], dtype=h5py.string_dtype())
        file["segments/start_s"], file["segments/end_s"] = [0.0], [len(sent_us) / 40]
        file.attrs["pulse_rate_hz"] = 40.0
    return path


def test_no_peak_is_lost_and_a_dropped_pulse_is_a_gap(tmp_path: Path) -> None:
    found = recorded(str(made_up(tmp_path / "r.h5", [100.0, 100.0, np.nan, 200.0], 30.0)), lambda *_: None)
    assert max(found["torque_nm"]) == 9.0 and len(found["time_s"]) <= 2000
    assert found["sent_pulse_width_us"] == [100.0, 100.0, None, 200.0, 200.0], "the first level reaches to the gap"
    assert found["pulses_end_s"] == pytest.approx(0.1)


@pytest.mark.parametrize("sent_us", [[], [0.0], [100.0] * 40])
def test_what_was_not_played_begins_where_the_pulses_end(tmp_path: Path, sent_us: list[float]) -> None:
    found = recorded(str(made_up(tmp_path / "r.h5", sent_us, 1.2 if sent_us else 0.0)), lambda *_: None)
    plan_us = [100.0] * 400
    figure = model_charts.recorded(found, plan_us, 40.0, "stopped")
    faint = figure.lines()["planned, not played"]
    assert faint.x[0] == pytest.approx(len(sent_us) / 40) and faint.colour == "plan"
    whole = model_charts.recorded(found, plan_us[: len(sent_us)], 40.0, "completed")
    assert "planned, not played" not in whole.lines()


# ---- What the service makes of the rig's numbers: bins for pages -----------------------------------------------------


ZERO_S = 50.0


def event(rows: list[tuple[float, float]], test_id: str | None = "T1") -> LiveEvent:
    """An event of samples, each with its time on the test's clock and its torque."""
    packed = [TORQUE_ROW.pack(ZERO_S + at_s, nan, nm, k, 255) for k, (at_s, nm) in enumerate(rows)]
    return LiveEvent(
        test_id=test_id, segment="prbs", elapsed_s=1.0, duration_s=9.0, torque_age_s=0.0, lost_samples=0,
        dropped_pulses=0, zero_s=ZERO_S, pulse_rate_hz=40.0, torque=b64encode(b"".join(packed)).decode(),
        outcomes=PulseOutcomes(
            index=[4, 5], pulse_width_us=[200.0, 0.0], written_time_s=[0.1, None], acknowledged_time_s=[0.101, None],
            status=[0, 1],
        ),
    )  # fmt: skip


def test_a_row_is_a_sample_as_the_rig_holds_it() -> None:
    assert SAMPLE == live.SAMPLE and TORQUE_ROW.size == SAMPLE.itemsize


def test_pages_get_the_lowest_and_highest_torque_of_each_bin_and_the_pulses() -> None:
    frame = frame_of(event([(0.501, 1.0), (0.504, 3.0), (0.509, 2.0), (0.511, nan), (0.515, -1.0), (0.525, nan)]))
    assert (frame.time_s, frame.torque_min_nm) == ([0.5, 0.51, 0.52], [1.0, -1.0, 0.0])
    assert frame.torque_max_nm == [3.0, 0.0, 0.0]
    assert (frame.pulse_time_s, frame.pulse_width_us) == ([0.1, 0.125], [200.0, 0.0])


@pytest.mark.parametrize(("test_id", "shown"), [("T1", [-0.5, 0.5]), (None, [-40.0, -0.5, 0.5, 3.0])])
def test_what_was_measured_far_from_the_test_is_not_drawn_in_it(test_id: str | None, shown: list[float]) -> None:
    assert frame_of(event([(-40.0, 1.0), (-0.495, 1.0), (0.505, 1.0), (3.0, 1.0)], test_id)).time_s == shown
