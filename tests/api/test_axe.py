"""Every page in every state under axe: no violation; at every size stop is uncovered, and nothing sticks out."""

from __future__ import annotations

import json
import re
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.store.tables import Model
from tests.api.browser import (
    PASSWORD,
    PHONE,
    TABLET,
    WIDE,
    ZOOMED,
    chart,
    look_closer,
    open_tab,
    participant,
    settled,
    sign_in_with_token,
    start,
)
from tests.api.conftest import Service, play_test, run_test, shared_service, soon, wait_done

axe_path = pytest.importorskip("axe_playwright_python.base").AXE_FILE_PATH
pytestmark = pytest.mark.browser

UNCOVERED = """() => { const b = document.getElementById('stop').getBoundingClientRect();
  const at = (x, y) => document.elementFromPoint(b.left + b.width * x, b.top + b.height * y);
  return [[.5, .5], [.03, .1], [.97, .9]].every(([x, y]) => at(x, y)?.id === 'stop'); }"""

STICKING_OUT = """() => [...document.querySelectorAll('body *')].filter((e) => !e.closest('.scroll, .sr') &&
  e.getBoundingClientRect().right > innerWidth + 1).slice(0, 5).map((e) => e.outerHTML.slice(0, 120))"""


service = shared_service(speed=8.0)


def violations(page: Any) -> list[str]:
    """What axe finds, rule by rule, with the elements. The page's own policy keeps foreign scripts out of its world."""
    if not page.evaluate("typeof window.axe === 'object'"):
        page.evaluate(Path(axe_path).read_text("utf-8"))
    found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    assert found["passes"] or found["violations"], "it has looked at something"
    return [
        f"{entry['id']} ({entry['impact']}): {json.dumps([node['html'][:160] for node in entry['nodes'][:3]])}"
        for entry in found["violations"]
    ]


def fits(page: Any, what: str) -> None:
    """Nothing sticks out to the right, once the page is whole and the figures have taken the new width."""
    page.wait_for_load_state()
    end = time.monotonic() + 8
    while not page.evaluate("document.documentElement.scrollWidth <= innerWidth"):
        assert time.monotonic() < end, (what, page.evaluate(STICKING_OUT))
        page.wait_for_timeout(100)


def examined(page: Any, what: str, stop: bool = True) -> None:
    """All sizes are looked at; axe takes one of two, chosen by the state's name: to run it is dear."""
    look = (WIDE, PHONE)[zlib.crc32(re.sub(r"[0-9a-f-]{8,}|T[0-9-]+\w*", "", what).encode()) % 2][0]
    for width, height in (WIDE, TABLET, ZOOMED, PHONE):
        page.set_viewport_size({"width": width, "height": height})
        fits(page, f"{what} at {width}")
        assert width != look or violations(page) == [], (what, width)
        assert not stop or page.evaluate(UNCOVERED), (what, width)


def visit(page: Any, service: Service, path: str, ready: Callable[[], Any] | None = None, stop: bool = True) -> None:
    page.set_viewport_size({"width": WIDE[0], "height": WIDE[1]})
    page.goto(service.url + path)
    settled(page)
    if ready:
        ready()
    examined(page, path, stop)


def test_pages_without_a_test(browser: Any, tab: Any, service: Service) -> None:
    visit(tab, service, "/")
    participant(tab, service, "X1")
    examined(tab, "empty participant")
    tab.get_by_label("Current of every pulse").fill("1.234,5")
    tab.get_by_role("button", name="Start the pre-session test").click()
    tab.get_by_text("is not a plain number").wait_for()
    examined(tab, "limits refused")
    tab.get_by_label("Current of every pulse").fill("40")
    tab.get_by_role("button", name="Set").click()
    tab.get_by_text("2 times as much").wait_for()
    examined(tab, "a jump is asked about")
    tab.get_by_role("link", name="No, go back").click()
    tab.get_by_role("button", name="Start the pre-session test").click()
    tab.get_by_role("button", name="Start now").wait_for()
    examined(tab, "before current flows")
    tab.get_by_role("link", name="No, go back").click()
    tab.get_by_text("Upload a recording of another tool").click()
    examined(tab, "participant, all open")
    for path in ("/models/none", "/nowhere", "/participants/X1/calibration", "/compare"):
        visit(tab, service, path)
    tab.goto(service.url + "/participants/X1/calibration")
    tab.get_by_role("button", name="Begin the calibration").click()
    tab.locator("#step-up").wait_for()
    examined(tab, "calibration")
    tab.get_by_role("button", name="Discard").click()
    for stranger in open_tab(browser, service, signed_in=False):
        visit(stranger, service, "/sign-in", stop=False)
        stranger.get_by_label("Name", exact=True).fill("Ada")
        stranger.get_by_label("Password").fill("not the password")
        stranger.get_by_role("button", name="Sign in", exact=True).click()
        stranger.get_by_text("do not match").wait_for()
        examined(stranger, "refused sign-in", stop=False)
        sign_in_with_token(stranger, service)
        visit(stranger, service, "/administration")
        stranger.get_by_label("Name of the controller").fill("ilc")
        stranger.get_by_role("button", name="Make the key").click()
        stranger.get_by_text("shown this once").wait_for()
        examined(stranger, "a new key")


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.campaign)])
def test_a_test_and_its_ends(browser: Any, service: Service, scheme: str) -> None:
    service.rig.speed = 0.7
    for page in open_tab(browser, service, color_scheme=scheme):
        participant(page, service, f"X2-{scheme}")
        start(page)
        page.locator("#age", has_text="ms").wait_for()
        examined(page, "live")
        page.get_by_role("button", name="Stop stimulation").click()
        page.get_by_text("The rig confirms").wait_for()
        examined(page, "stopped")
        visit(page, service, "/")
        visit(page, service, f"/participants/X2-{scheme}")
        service.rig.confirms_stop = False
        page.get_by_role("button", name="Stop stimulation").click()
        page.get_by_role("heading", name="The stop is not confirmed").wait_for()
        examined(page, "not confirmed")
    service.rig.speed = 8.0


def test_a_model_and_what_is_made_of_it(tab: Any, service: Service, client: httpx.Client) -> None:
    first = play_test(client, "X3")
    second = run_test(client, "X3")

    def drawn() -> None:
        tab.get_by_role("link", name="Fatigue").wait_for()
        chart(tab, "overview")

    def opened() -> None:
        tab.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        for figure in ("comparison", "recruitment", "residual"):
            chart(tab, figure)
        look_closer(tab, "step")

    visit(tab, service, f"/models/{first['model_id']}", drawn)
    opened()
    examined(tab, "model, all open")
    tab.get_by_role("button", name="Add this effect").click()
    tab.wait_for_url(lambda url: first["model_id"] not in url)  # a chart of the page before would be gone meanwhile
    chart(tab, "falling")
    settled(tab)
    examined(tab, "versions")
    visit(tab, service, f"/models/{first['model_id']}/report", stop=False)
    visit(tab, service, f"/tests/{first['id']}")
    both = f"/compare?model={first['model_id']}&model={second['model_id']}"
    visit(tab, service, both, lambda: chart(tab, "step"))
    for path in ("/participants/X3", "/participants/X3/trend", f"/models/{first['model_id']}/widths"):
        visit(tab, service, path)
    visit(tab, service, "/jobs/none")
    row = service.context.store.get(Model, second["model_id"])
    service.change(Model, row.id, fit={**row.fit, "verdict": "not usable"})
    visit(tab, service, f"/models/{row.id}/approve")


def test_trials_of_a_controller(tab: Any, service: Service, client: httpx.Client) -> None:
    model = play_test(client, "X7")["model_id"]
    client.post(f"/v1/models/{model}/approve")
    (service.data / "recordings" / "track.json").write_text(json.dumps({"values": {"gain": 0.5}}))
    trial = client.post("/v1/tests", json={"participant": "X7", "kind": "sequence"}).json()
    wait_done(client, trial["id"])
    assert client.get("/v1/participants/X7/model?tracked=true").json()["tracking"]["ask"]
    visit(tab, service, "/participants/X7", tab.get_by_text("All trials as a table").click)


def test_widths_for_a_torque_and_a_controllers_key(tab: Any, service: Service, tmp_path: Path) -> None:
    model = service.play_test("X7")["model_id"]
    reference = tmp_path / "reference.csv"
    reference.write_text("torque_nm\n0\n1\n2\n")
    visit(tab, service, f"/models/{model}/widths")
    tab.get_by_label("CSV with").set_input_files(reference)
    tab.get_by_role("button", name="Find the pulse widths").click()
    tab.get_by_role("heading", name="Out of reach").wait_for()
    examined(tab, "widths for a torque")
    with tab.expect_download() as download:
        tab.get_by_role("button", name="Download the widths").click()
    assert Path(download.value.path()).read_text().startswith("time_s,pulse_width_us")
    visit(tab, service, "/participants/X7")
    tab.get_by_label("Name of the controller").fill("ilc")
    tab.get_by_label("Your password, once more").fill(PASSWORD)
    tab.get_by_role("button", name="Make the key").click()
    tab.get_by_text("shown this once").wait_for()
    examined(tab, "a key")
    tab.get_by_role("button", name="Revoke the key of ilc").click()
    tab.get_by_role("cell", name="revoked").wait_for()


def test_a_diagnosis_under_way(tab: Any, service: Service) -> None:
    marker = service.data / "recordings" / "slow"
    marker.write_text("0.4")
    try:
        with service.client() as http:
            http.post("/v1/participants", json={"code": "X4"})
            started = http.post("/v1/tests", json={"participant": "X4"}).json()
            model = wait_done(http, started["id"], 60.0)["model_id"]
        tab.goto(f"{service.url}/models/{model}")
        tab.get_by_role("button", name="Cancel").wait_for()
        examined(tab, "diagnosing")
    finally:
        marker.unlink()
        tab.get_by_role("button", name="Cancel").click()
        tab.get_by_role("link", name="Diagnose now").wait_for()


def test_without_a_rig(tab: Any, service: Service) -> None:
    service.rig_thread.__exit__()
    try:
        tab.goto(service.url + "/")
        tab.get_by_text("The rig cannot be reached.").wait_for()
        examined(tab, "no rig")
        tab.get_by_role("button", name="Stop stimulation").click()
        tab.get_by_role("heading", name="The stop is not confirmed").wait_for()
        assert "emergency switch" in tab.locator("section [role=alert]").first.inner_text()
        examined(tab, "stop without a rig")
    finally:
        service.rig_thread.__enter__()
        with service.client() as http:
            soon(lambda: http.get("/v1/rig").json()["connected"], 20)
