"""`python -m bench.clinician_day`: clicks and seconds from signing in to an approved model, and where things stand.

`stimrig serve` with the emulated rig at the speed of the world, Debian's chromium, a person who reads nothing. A click
is a press of a button, a link or a key; a field that is typed into counts as one. `calibration_keys` are the trains,
marks and the end of a calibration: as many as the person's answers need; `clicks_without_them` are the rest. Four days:
a new and a known participant, without an effect (patient `paper`) and with one (`--hidden` of `EFFECT_SEED`). On the
second day of the participant with an effect the structure of the first day carries over.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from playwright.sync_api import Locator, Page, sync_playwright

from bench.common import services, sign_in
from tests.api.browser import ARGUMENTS, CHROMIUM, PASSWORD

PERSON = {"sensory": 60.0, "motor": 100.0, "comfort": 300.0}
REST = "#calibration[data-open]:not([data-playing])"
EFFECT_SEED = 3
SIZES = {"laptop": (1366, 768), "tablet": (820, 1180)}
LONG_MS = 180_000


@dataclass
class Day:
    """What one person did: presses and seconds, by part of the day."""

    page: Page
    clicks: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    part: str = ""

    @contextmanager
    def doing(self, part: str) -> Iterator[None]:
        """A part of the day."""
        self.part, begun_s = part, time.monotonic()  # a calibration's keys are counted apart
        self.clicks.setdefault(part, 0)
        yield
        self.seconds[part] = round(self.seconds.get(part, 0.0) + time.monotonic() - begun_s, 1)

    def click(self, target: Locator) -> None:
        """Press it once it is there."""
        target.click(timeout=LONG_MS)
        self.clicks[self.part] = self.clicks.get(self.part, 0) + 1

    def key(self, name: str) -> None:
        """Press a key."""
        self.page.keyboard.press(name)
        self.clicks[self.part] = self.clicks.get(self.part, 0) + 1

    def type(self, label: str, text: str) -> None:
        """Type into a field."""
        self.page.get_by_label(label, exact=True).first.fill(text)
        self.clicks[self.part] = self.clicks.get(self.part, 0) + 1

    def document(self) -> dict[str, Any]:
        """Counts and times; the time in which the test plays is apart."""
        waited = self.seconds.get("test plays", 0.0)
        keys, clicks = self.clicks.get("calibration keys", 0), sum(self.clicks.values())
        total = {
            "clicks": clicks,
            "calibration_keys": keys,
            "clicks_without_them": clicks - keys,
            "seconds": round(sum(self.seconds.values()), 1),
        }
        return {**total, "seconds_without_the_test": round(total["seconds"] - waited, 1),
                "by_part": {part: [self.clicks[part], self.seconds.get(part)] for part in self.clicks}}  # fmt: skip


def live(day: Day, url: str, code: str, new: bool) -> dict[str, Any]:
    """From the door to an approved model."""
    page = day.page
    page.context.clear_cookies()
    page.goto(f"{url}/")
    with day.doing("sign in"):
        day.type("Name", "Ada")
        day.type("Password", PASSWORD)
        day.click(page.get_by_role("button", name="Sign in", exact=True))
        page.get_by_role("heading", name="Participants").wait_for()
    with day.doing("open"):
        if new:
            day.type("Code", code)
            day.click(page.get_by_role("button", name="Create"))
        else:
            day.click(page.get_by_role("link", name=code, exact=True))
        page.get_by_role("heading", name=code).wait_for()
    with day.doing("calibrate"):
        calibrate(day, code, PERSON)
    with day.doing("start"):
        day.click(page.get_by_role("button", name="Start the pre-session test").first)
        day.click(page.get_by_role("button", name="Start now"))
        page.wait_for_url("**/tests/T*")
    with day.doing("test plays"):
        page.wait_for_url("**/models/*", timeout=LONG_MS)
    with day.doing("look"):
        page.locator(".why-head").wait_for(timeout=LONG_MS)
    where = {name: places(page, size) for name, size in SIZES.items()}
    added = []
    with day.doing("add effects"):
        while (add := page.locator(".missing form button.primary")).count():
            added.append(page.locator(".missing .strong").first.inner_text())
            before = page.url
            day.click(add.first)
            page.wait_for_url(lambda now, before=before: "/models/" in now and now != before, timeout=LONG_MS)
            page.locator(".why-head").wait_for(timeout=LONG_MS)
    with day.doing("approve"):
        if page.get_by_label("Your password, once more").first.count():
            day.type("Your password, once more", PASSWORD)
        day.click(page.get_by_role("button", name="Approve", exact=True))
        page.get_by_text("Approved by Ada").first.wait_for()
    return {**day.document(), "added": added, "places": where}


def calibrate(day: Day, code: str, answers: dict[str, float]) -> int:
    """By keys, answers at once, from the participant's page; how many trains it took."""
    page = day.page
    if not (begin := page.locator(".next button", has_text="Begin the calibration")).count():  # it holds for today
        day.click(page.get_by_role("link", name="Calibrate", exact=True))
        begin = page.get_by_role("button", name="Begin the calibration")
    day.click(begin)
    day.part = "calibration keys"
    trains = 0
    for number, wanted_us in enumerate(answers.values(), start=1):
        while True:
            page.locator(REST).wait_for()
            width_us = float(page.locator(".now b").inner_text().split()[0])
            if trains and width_us >= wanted_us:
                break
            day.key("ArrowUp")
            trains += 1
            told = "(n) => document.querySelector('[name=calibration]').value.split('.')[1] == n"
            page.wait_for_function(told, arg=str(trains))
        day.key("m")
        page.wait_for_function("(n) => document.querySelectorAll('.marks b').length == n", arg=number)
    day.key("Enter")
    page.wait_for_url(f"**/participants/{code}")
    return trains


def places(page: Page, size: tuple[int, int]) -> dict[str, float]:
    """Lower edges on the page, px from its top: the verdict, the chart, what is missing, its *Add*."""
    before = page.viewport_size
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.evaluate("scrollTo(0, 0)")
    marks = {"verdict": ".verdict h2", "chart": "#torque .figure-box", "missing": ".why-head", "add": ".missing button"}
    found = {}
    for name, mark in marks.items():
        box = page.locator(mark).first.bounding_box() if page.locator(mark).count() else None
        if box is not None:
            found[name] = round(box["y"] + box["height"])
    if before:
        page.set_viewport_size(before)
    return found | {"screen": size[1]}


def main() -> None:
    """Live the four days, print what they took."""
    found: dict[str, Any] = {}
    patients = {"without an effect": "--patient paper", "with an effect": f"--hidden {EFFECT_SEED}"}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        for name, emulate in patients.items():
            with services(*emulate.split()) as (running, _):
                page = browser.new_page(viewport={"width": 1366, "height": 768})
                sign_in(page, running.url, PASSWORD)
                for who, new in (("new", True), ("known", False)):
                    found[f"{who}, {name}"] = live(Day(page), running.url, "P017", new)
                    print(f"{who}, {name}: {json.dumps(found[f'{who}, {name}'])}", file=sys.stderr)
                page.close()
        browser.close()
    print(json.dumps(found | {"cores": os.cpu_count(), "load_average": os.getloadavg()[0]}))


if __name__ == "__main__":
    main()
