"""A whole day by keys alone, from signing in to an approved model; and how many presses it takes."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.browser import NAME, PASSWORD, expected, open_tab, settled, there
from tests.api.conftest import Service, shared_service

pytestmark = pytest.mark.browser
service = shared_service()
FOCUSED = """() => { const e = document.activeElement, s = getComputedStyle(e), b = e.getBoundingClientRect();
  const label = e.labels && e.labels.length ? e.labels[0].textContent : e.getAttribute('aria-label') || e.textContent;
  return {names: [e.id, label.trim()], ring: s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) >= 1,
          there: b.bottom > 0 && b.top < innerHeight, top: e === document.body}; }"""


class Hand:
    """A person without a mouse. Counted: keys that do something, fields; neither Tab, nor a calibration's keys."""

    def __init__(self, page: Any) -> None:
        self.page, self.count = page, 0

    def to(self, name: str) -> None:
        """By Tab to what has this id or name; on the way every stop is seen, and none holds the focus."""
        settled(self.page)
        stops = self.page.locator("a, button, input, select, textarea, summary, [tabindex]").count() + 2
        for _ in range(stops):
            self.page.keyboard.press("Tab")
            at = self.page.evaluate(FOCUSED)
            assert at["top"] or (at["ring"] and at["there"]), at
            if any(text == name or text.startswith(f"{name}:") for text in at["names"]):
                return
        raise AssertionError(f"{name} cannot be reached by Tab")

    def press(self, name: str) -> None:
        self.to(name)
        self.enter()

    def type(self, name: str, text: str) -> None:
        self.to(name)
        self.page.keyboard.type(text)
        self.count += 1

    def enter(self) -> None:
        self.page.keyboard.press("Enter")
        self.count += 1


def sign_in(hand: Hand, service: Service) -> None:
    hand.page.goto(service.url)
    hand.page.locator("#name:focus").wait_for()  # it has the focus by itself
    hand.page.keyboard.type(NAME)
    hand.count = 1
    hand.type("password", PASSWORD)
    hand.enter()
    there(hand.page, "Participants")


def calibrate(hand: Hand) -> None:
    """Its keys are those of the page that says so."""
    hand.press("Begin the calibration")
    page = hand.page
    page.locator("#step-up").wait_for()
    page.wait_for_load_state()
    for count in (1, 2, 3):
        expected(page.locator("#step-up")).to_be_enabled()
        page.keyboard.press("ArrowUp")
        expected(page.locator("[aria-label=Trains] tbody tr")).to_have_count(count)
        expected(page.locator("#mark-sensory")).to_be_enabled()
        page.keyboard.press("m")
        expected(page.locator(".marks b")).to_have_count(count)
    page.keyboard.press("Enter")
    page.get_by_text("Start the pre-session test").first.wait_for()


def play_and_approve(hand: Hand, service: Service) -> None:
    """From the participant's page to an approved model; the model's page comes by itself once the test's is there."""
    service.rig.speed = 1.0
    hand.press("Start the pre-session test")
    hand.page.get_by_role("heading", name="Start the pre-session test of").wait_for()
    hand.press("Start now")
    hand.page.locator("#age", has_text="ms").wait_for()
    service.rig.speed = 60.0
    hand.page.wait_for_url("**/models/*")
    hand.type("approve-password", PASSWORD)
    hand.enter()
    hand.page.get_by_text(f"Approved by {NAME}").first.wait_for()


def test_from_signing_in_to_an_approved_model(browser: Any, service: Service) -> None:
    """At most 12 presses with a new participant, 9 with a known one; the trains and answers of a calibration apart."""
    with service.client() as http:
        http.post("/v1/users", json={"name": NAME, "password": PASSWORD})
    (service.data / "recordings" / "nothing-missing").touch()
    for page in open_tab(browser, service, signed_in=False):
        hand = Hand(page)
        sign_in(hand, service)
        hand.type("code", "D1")
        hand.enter()
        there(page, "D1")
        settled(page)
        for name in ("Skip to content", "Stop stimulation"):
            page.keyboard.press("Tab")
            assert page.evaluate("document.activeElement.textContent.trim()") == name
        calibrate(hand)
        play_and_approve(hand, service)
        assert hand.count == 10, "name, password, in; code, create; begin; start, now; password, approve"
        hand.press("Sign out")
        page.get_by_role("heading", name="Sign in").wait_for()
        sign_in(hand, service)
        hand.press("D1")
        there(page, "D1")
        hand.press("Calibrate")  # it holds for today; the next day the line begins it, as above
        page.get_by_role("heading", name="Begin").wait_for()
        page.go_back()
        play_and_approve(hand, service)
        assert hand.count <= 9, "the one that looks at the calibration stands for the one that begins it"
