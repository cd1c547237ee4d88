"""What a clinician, a reader and an administrator do on the page, by mouse and by keyboard alone."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.api.browser import (
    NAME,
    PASSWORD,
    bring_to_rest,
    expected,
    gone,
    open_tab,
    participant,
    sign_in,
    sign_in_with_token,
    start,
    there,
    without_values,
)
from tests.api.conftest import Service, run_test, shared_service, wait_done
from tests.api.test_access import HTML, csrf, signed_in

pytestmark = pytest.mark.browser


service = shared_service(speed=8.0)


@pytest.fixture
def blank(browser: Any, service: Service) -> Iterator[Any]:
    """A tab in which nobody has signed in."""
    yield from open_tab(browser, service, signed_in=False)


def a_model(service: Service, code: str) -> dict[str, Any]:
    with service.client() as http:
        http.post("/v1/participants", json={"code": code})
        return run_test(http, code)


def test_approval_wants_the_password_a_rejection_a_reason_and_says_what_is_wrong(tab: Any, service: Service) -> None:
    model = a_model(service, "C1")["model_id"]
    tab.goto(f"{service.url}/models/{model}")
    tab.get_by_role("button", name="Approve").click()
    assert tab.url.endswith(model), "the browser asks for the password first"
    tab.get_by_label("Your password, once more").first.fill("not my password")
    tab.get_by_role("button", name="Approve").click()
    tab.get_by_role("heading", name="The password does not match").wait_for()
    tab.get_by_role("link", name="Back to the model").click()
    tab.get_by_text("Not approved yet").wait_for()
    tab.get_by_label("Your password, once more").first.fill(PASSWORD)
    tab.get_by_role("button", name="Approve").click()
    tab.get_by_text(f"Approved by {NAME}").wait_for()
    tab.get_by_text("Withdraw it from the controller").click()
    tab.get_by_label("Reason").fill("electrode slipped")
    tab.get_by_label("Your password, once more").first.fill(PASSWORD)
    tab.get_by_role("button", name="Reject").click()
    tab.get_by_text("electrode slipped").wait_for()
    with service.client() as http:
        assert http.get("/v1/participants/C1/model").status_code == 404
        deeds = [(e["who"], e["action"], e["detail"].get("reason")) for e in http.get("/v1/audit").json()["entries"]]
    assert (NAME, "approve", "") in deeds and (NAME, "reject", "electrode slipped") in deeds


def test_a_form_without_a_reason_decides_nothing(service: Service) -> None:
    model = a_model(service, "C2")["model_id"]
    with signed_in(service) as browser:
        refused = browser.post(f"/models/{model}/reject", data={"csrf": csrf(browser), "reason": "  "})
    assert refused.status_code == 422 and "needs a reason" in refused.text
    with service.client() as http:
        assert http.get(f"/v1/models/{model}").json()["decision"] is None


def test_every_export_of_a_model_and_a_test_is_there(tab: Any, service: Service) -> None:
    done = a_model(service, "C3")
    tab.goto(f"{service.url}/models/{done['model_id']}")
    exports = tab.get_by_role("group", name="Export")
    for name, suffix in (("MODEL.json", ".json"), ("HDF5", ".h5"), ("CSV", ".csv")):
        with tab.expect_download() as caught:
            exports.get_by_role("link", name=name).click()
        assert caught.value.suggested_filename.endswith(suffix)
        body = Path(caught.value.path()).read_bytes()
        if suffix == ".json":
            assert json.loads(body)["model_id"] == done["model_id"]
        else:
            assert body.startswith(b"\x89HDF" if suffix == ".h5" else b"time_s,pulse_width_us,torque_nm,segment")
    exports.get_by_role("link", name="Report").click()
    there(tab, "Muscle model of C3")
    pages = re.findall(rb"/Type\s*/Page\b", tab.pdf(prefer_css_page_size=True))
    assert len(pages) == 1, "the report is one sheet"
    assert tab.locator("svg.still").count() == 3 and tab.locator("script").count() == 0
    assert not list((service.data / "exports").iterdir()), "what was handed out is not kept twice"
    assert tab.errors == []


def test_stop_during_a_fit_is_confirmed_and_the_model_still_comes(tab: Any, service: Service) -> None:
    marker = service.data / "recordings" / "fitting-slowly"
    code = f"F{time.time_ns() % 10**9}"
    participant(tab, service, code)
    marker.touch()
    try:
        start(tab)
        tab.locator("#state", has_text="identifying").wait_for(timeout=20_000)
        tab.get_by_role("button", name="Stop stimulation").click()
        tab.get_by_text("The rig confirms that stimulation is off.").wait_for()
    finally:
        marker.unlink()
    with service.client() as http:
        (test,) = http.get(f"/v1/participants/{code}/tests").json()
        test = wait_done(http, test["id"])
    assert test["state"] == "completed" and test["model_id"]


def test_a_reader_sees_no_deeds_and_may_stop(service: Service) -> None:
    model = a_model(service, "C4")["model_id"]
    with service.client() as http:
        body = {"name": "Rosa", "password": PASSWORD, "scopes": ["read-live", "read-model"]}
        assert http.post("/v1/users", json=body).status_code in (201, 409)
    with service.client(token=None, headers=HTML, follow_redirects=True) as page:
        home = page.post("/sign-in", data={"name": "Rosa", "password": PASSWORD}).text
        assert "You may not see this list" in home and "C4" not in without_values(home)
        shown = page.get(f"/models/{model}").text
        assert "A clinician approves or rejects it." in shown
        buttons = [
            re.sub(r"<[^>]*>", "", text).strip() for text in re.findall(r"<button.*?</button>", shown, re.DOTALL)
        ]
        deeds = {"Approve", "Reject", "Improve", "Add this effect", "Run it now", "Undo"}
        assert "Stop stimulation" in " ".join(buttons) and not deeds & set(buttons), buttons
        assert page.get("/administration").status_code == 403
        assert "The rig confirms that stimulation is off" in page.post("/v1/stop", data={}).text
    assert service.rig.stopped_by == "Rosa"
    bring_to_rest(service)


def test_an_administrator_adds_a_clinician_and_a_key_by_clicking(blank: Any, service: Service) -> None:
    sign_in_with_token(blank, service)
    blank.get_by_role("link", name="Administration").click()
    name = f"Ben{time.time_ns() % 10**6}"
    blank.get_by_label("Name", exact=True).fill(name)
    blank.get_by_label("First password").fill(PASSWORD)
    blank.get_by_role("button", name="Add").click()
    blank.get_by_role("cell", name=name, exact=True).first.wait_for()
    blank.get_by_label("Name of the controller").fill("ilc in room 3")
    blank.get_by_role("button", name="Make the key").click()
    key = blank.locator(".notice .mono").inner_text()
    with service.client(key) as controller:
        assert controller.get("/v1/participants/none/model").status_code == 404
        assert controller.get("/v1/rig").status_code == 403
    expected(blank.get_by_text("The chain of hashes is complete")).to_be_visible()
    with blank.expect_download() as caught:
        blank.get_by_role("link", name="Export all").click()
    from stimrig.api.cli import main

    assert main.run(["audit", "verify", "--file", str(caught.value.path())]) == 0
    blank.get_by_role("button", name=re.compile("Revoke the token of ilc")).first.click()
    blank.get_by_text("revoked").first.wait_for()
    with service.client(key) as controller:
        assert controller.get("/v1/participants/none/model").status_code == 401
    blank.get_by_role("button", name="Sign out").click()
    sign_in(blank, service, name)
    assert blank.get_by_role("link", name="Administration").count() == 0


def test_the_whole_way_by_keyboard_alone(blank: Any, service: Service) -> None:
    """Sign in, make a participant, start, stop, re-arm: only keys."""
    with service.client() as http:
        http.post("/v1/users", json={"name": NAME, "password": PASSWORD})
    service.rig.speed = 1.5
    blank.goto(service.url)
    keys = blank.keyboard
    blank.locator("#name:focus").wait_for()  # it has the focus by itself
    keys.type(NAME)
    keys.press("Tab")
    keys.type(PASSWORD)
    keys.press("Enter")
    blank.get_by_role("heading", name="Participants").wait_for()
    tab_to(blank, "code")
    keys.type(f"B{time.time_ns() % 10**9}")
    keys.press("Enter")
    blank.get_by_role("button", name="Start the pre-session test").wait_for()
    tab_to(blank, "Start the pre-session test")
    keys.press("Enter")
    blank.get_by_role("heading", name="Start the pre-session test of").wait_for()
    tab_to(blank, "Start now: 20 mA, 300 µs")
    keys.press("Enter")
    blank.wait_for_url("**/tests/T*")
    tab_to(blank, "stop")
    keys.press("Space")
    blank.get_by_text("The rig confirms that stimulation is off.").wait_for()
    tab_to(blank, "To the participants")
    keys.press("Enter")
    blank.get_by_role("button", name="I have checked: re-arm").wait_for()
    blank.get_by_text("stays stopped").wait_for()
    tab_to(blank, "I have checked: re-arm")
    keys.press("Enter")
    blank.get_by_role("heading", name="Participants").wait_for()
    gone(blank.get_by_text("stays stopped"))
    service.rig.speed = 8.0


def tab_to(page: Any, name: str) -> None:
    """Press Tab until what has this id or text has the focus; each stop on the way is seen."""
    page.wait_for_load_state()
    for _ in range(40):
        page.keyboard.press("Tab")
        at = page.evaluate(
            """() => { const e = document.activeElement, s = getComputedStyle(e);
              return {id: e.id, text: e.textContent.trim(), ring: s.outlineStyle !== 'none'}; }"""
        )
        assert at["ring"], at
        if name in (at["id"], at["text"]):
            return
    raise AssertionError(f"{name} cannot be reached by Tab")
