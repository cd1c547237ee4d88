"""`python -m bench.calibration_clicks`: keys, trains and seconds that a calibration takes.

`stimrig serve` with the emulated rig at the speed of the world, Debian's chromium, keys alone. The person feels
60 µs, moves at 100 µs and finds 300 µs the strongest comfortable pulse; answers come at once, so the seconds hold no
reading time and no talk. *before*: every step 10 µs, as `large_steps` false still does. *near*: the thresholds are
not exactly last time's. A click that opens the calibration's page is counted, and the one that takes the limits over.
"""

from __future__ import annotations

import json
import os
import time
from typing import Any

import httpx
from playwright.sync_api import Page, sync_playwright

from bench.clinician_day import PERSON, TOKEN, Day, calibrate, served, sign_in
from tests.api.browser import ARGUMENTS, CHROMIUM

NEAR = {"sensory": 66.0, "motor": 94.0, "comfort": 290.0}


def count(page: Page, url: str, code: str, answers: dict[str, float]) -> dict[str, Any]:
    """One calibration by keys; the participant's page is open."""
    page.goto(f"{url}/participants/{code}")
    day = Day(page)
    with day.doing("calibrate"):
        trains = calibrate(day, code, answers)
    return {"keys": day.clicks["calibrate"], "trains": trains, "seconds": day.seconds["calibrate"]}


def before(http: httpx.Client, code: str, answers: dict[str, float]) -> dict[str, float]:
    """The same by REST in steps of 10 µs: one press for each train, each mark, begin and finish, and the page."""
    where = f"/v1/participants/{code}/calibration"
    begun_s = time.monotonic()
    http.post(where).raise_for_status()
    trains, width_us = 0, 0.0
    for threshold, wanted_us in answers.items():
        while width_us < wanted_us:
            http.post(f"{where}/step", json={"direction": "up"}).raise_for_status()
            trains += 1
            while (now := http.get(where).json())["playing"]:
                time.sleep(0.05)
            width_us = now["pulse_width_us"]
        http.post(f"{where}/mark", json={"threshold": threshold}).raise_for_status()
    http.post(f"{where}/finish").raise_for_status()
    return {"keys": trains + 6, "trains": trains, "seconds": round(time.monotonic() - begun_s, 1)}


def measure(url: str, page: Page) -> dict[str, Any]:
    """Before and after, for a participant whom nobody knows and for one who comes again."""
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=30) as http:
        for code in ("OLD", "NEW"):
            http.post("/v1/participants", json={"code": code}).raise_for_status()
        found: dict[str, Any] = {"before": before(http, "OLD", PERSON)}
        sign_in(page, url)
        found["new"] = count(page, url, "NEW", PERSON)
        for name, answers in (("known", PERSON), ("known, near", NEAR)):
            found[name] = count(page, url, "OLD", answers)
        return found | {"cores": os.cpu_count(), "load_average": os.getloadavg()[0]}


def main() -> None:
    """Measure and say."""
    with served() as url, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        print(json.dumps(measure(url, page)))
        browser.close()


if __name__ == "__main__":
    main()
