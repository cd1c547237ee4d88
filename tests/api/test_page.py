"""The page in a real browser and without scripts: stop in every state, stale data, exports, what a reader sees."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.web import pages
from tests.api.browser import (
    NAME,
    PASSWORD,
    bring_to_rest,
    expected,
    gone,
    open_tab,
    participant,
    start,
    without_values,
)
from tests.api.conftest import HTML, Service, shared_service, soon, wait_done

service = shared_service(speed=8.0)
STATIC = Path(pages.__file__).parent / "static"


@pytest.mark.browser
def test_stop_works_while_the_live_channel_is_cut(tab: Any, service: Service) -> None:
    participant(tab, service, "C1")
    tab.route_web_socket("**/live", lambda socket: socket.close())
    start(tab)
    tab.locator("#stale").wait_for()
    tab.get_by_role("button", name="Stop stimulation").click()
    tab.get_by_text("The rig confirms that stimulation is off.").wait_for()


@pytest.mark.browser
def test_without_scripts_signing_in_and_stop_work_and_the_page_says_so(
    browser: Any, service: Service, client: httpx.Client
) -> None:
    client.post("/v1/users", json={"name": NAME, "password": PASSWORD})
    client.post("/v1/participants", json={"code": "N1"})
    for page in open_tab(browser, service, signed_in=False, java_script_enabled=False):
        page.goto(f"{service.url}/sign-in?next=/participants/N1")
        page.get_by_label("Name", exact=True).fill(NAME)
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("button", name="Sign in", exact=True).click()
        page.wait_for_url("**/participants/N1")
        assert "This page needs scripts." in page.content()
        client.post("/v1/tests", json={"participant": "N1"})
        page.get_by_role("button", name="Stop stimulation").click()
        page.get_by_text("The rig confirms that stimulation is off.").wait_for()


SEEN_STALE = """() => { const banner = document.getElementById('stale');
  new MutationObserver(() => { if (!banner.hidden) window.staleAt ??= performance.now(); })
    .observe(banner, {attributes: true}); }"""


@pytest.mark.browser
def test_data_grow_stale_within_a_second_when_the_rig_dies(tab: Any, service: Service) -> None:
    service.rig.speed = 1.5
    participant(tab, service, f"R{time.time_ns() % 10**9}")
    start(tab)
    tab.locator("#age", has_text="ms").wait_for()
    tab.evaluate(SEEN_STALE)
    service.rig_thread.__exit__()
    tab.locator("#stale").wait_for()
    assert tab.evaluate("staleAt - state.heard") < 1000, "by the page's own clock, since the last frame"
    assert tab.locator("#live.is-stale").count() == 1
    service.rig_thread.__enter__()
    tab.get_by_text("rig's process ended").first.wait_for()


@pytest.mark.browser
def test_limits_for_today_are_set_by_a_key(tab: Any, service: Service) -> None:
    participant(tab, service, "L1")
    tab.get_by_label("Current of every pulse").fill("17,5")
    tab.keyboard.press("Enter")
    tab.get_by_text("Begin the calibration: 17.5 mA").wait_for()
    assert service.rig.state == "ready", "the key in the field starts nothing"


@pytest.mark.browser
def test_a_page_that_waits_takes_nothing_away_that_somebody_writes(tab: Any) -> None:
    """Work that ends while a password is typed must not read the page anew: the next click would be lost."""
    scripts = "".join((STATIC / name).read_text(encoding="utf-8") for name in ("act.js", "wait.js"))
    body = (
        '<input id="mine"><div data-job="J"><b data-words></b><span data-left></span><progress></progress></div>'
        f"<script>{scripts}</script>"
    )
    job = {"progress": 0.5, "text": "at work", "time_left_s": 2.0, "done": False}
    answers = iter([500, 503])  # of a service that starts again
    tab.route("http://wait.test/v1/jobs/J", lambda route: route.fulfill(json=job, status=next(answers, 200)))
    tab.route("http://wait.test/", lambda route: route.fulfill(body=body, content_type="text/html; charset=utf-8"))
    tab.goto("http://wait.test/")
    tab.get_by_text("at work").wait_for()
    tab.locator("#mine").fill("half a passw")
    job["done"] = True
    tab.get_by_role("button", name="Show it").wait_for()
    assert tab.locator("#mine").input_value() == "half a passw"
    job["done"] = False
    tab.get_by_role("button", name="Show it").click()
    expected(tab.locator("#mine")).to_have_value("")
    gone(tab.get_by_role("button", name="Show it"))


def test_every_export_of_a_model_is_there(service: Service, pages: httpx.Client) -> None:
    model = service.play_test("C3")["model_id"]
    exports = pages.get(f"/models/{model}").text.partition('aria-label="Export"')[2].partition("</div>")[0]
    links = {text: href for href, text in re.findall(r'href="([^"]+)"[^>]*>([^<]+)<', exports)}
    begins = {"MODEL.json": b"{", "HDF5": b"\x89HDF", "CSV": b"time_s,pulse_width_us,torque_nm,segment"}
    for name, first in begins.items():
        answer = pages.get(links[name])
        assert "filename=" in answer.headers["content-disposition"] and answer.content.startswith(first), name
    report = pages.get(links["Report"]).text
    assert "Muscle model of C3" in report and report.count('class="still"') == 4 and "<script" not in report
    assert not list((service.data / "exports").iterdir()), "what was handed out is not kept twice"


def test_stop_during_a_fit_is_confirmed_and_the_model_still_comes(service: Service, client: httpx.Client) -> None:
    marker = service.data / "recordings" / "fitting-slowly"
    client.post("/v1/participants", json={"code": "F1"})
    marker.touch()
    try:
        test_id = client.post("/v1/tests", json={"participant": "F1"}).json()["id"]
        soon(lambda: client.get(f"/v1/tests/{test_id}").json()["state"] == "identifying")
        assert client.post("/v1/stop").json()["stopped"]
    finally:
        marker.unlink()
    test = wait_done(client, test_id)
    assert test["state"] == "completed" and test["model_id"]
    bring_to_rest(service)


def test_a_reader_sees_no_deeds_and_may_stop(service: Service, client: httpx.Client) -> None:
    model = service.play_test("UNSEEN-4")["model_id"]
    body = {"name": "Rosa", "password": PASSWORD, "scopes": ["read-live", "read-model"]}
    assert client.post("/v1/users", json=body).status_code in (201, 409)
    with service.client(token=None, headers=HTML, follow_redirects=True) as page:
        home = page.post("/v1/sessions", data={"name": "Rosa", "password": PASSWORD}).text
        assert "You may not see this list" in home and "UNSEEN-4" not in without_values(home)
        shown = page.get(f"/models/{model}").text
        assert "A clinician approves or rejects it." in shown
        buttons = re.sub(r"<[^>]*>", "", " ".join(re.findall(r"<button.*?</button>", shown, re.DOTALL)))
        assert "Stop stimulation" in buttons
        assert not re.search("Approve|Reject|Improve|Add this effect|Run it now", buttons), buttons
        assert page.get("/administration").status_code == 403
        assert "The rig confirms that stimulation is off" in page.post("/v1/stop", data={}).text
    assert service.rig.stopped_by == "Rosa"
    bring_to_rest(service)
