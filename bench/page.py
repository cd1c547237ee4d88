"""`python -m bench.page [--runs N]`: what the page weighs, when its first chart is there, how fluent the live view is.

Service, real workers and a fake rig (`tests/api/fake_rig.py`, 20 frames a second at the speed of the world) on this
machine, Debian's chromium. *Cold*: an empty cache; *warm*: the cache of the page before.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import sync_playwright

from bench.common import parser
from stimrig.api.workers.pool import WORKER
from tests.api.browser import ARGUMENTS, CHROMIUM, participant, sign_in, start
from tests.api.conftest import Service, run_service, run_test

LIVE_S = 10.0
WEIGHT = """() => {
  const all = ['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind));
  return [all.length, all.reduce((sum, entry) => sum + entry.transferSize, 0)]; }"""
FIRST_CHART = """() => new Promise((done) => {
  const look = () => document.querySelector('.main-svg .scatterlayer path')
    ? done(performance.now()) : requestAnimationFrame(look);
  look(); })"""
FRAMES = """(ms) => new Promise((done) => {
  const begin = performance.now(); let count = 0;
  const tick = () => {
    const elapsed = performance.now() - begin; count++;
    if (elapsed < ms) requestAnimationFrame(tick); else done(1000 * count / elapsed); };
  requestAnimationFrame(tick); })"""


def opened(browser: Any, service: Service) -> Any:
    """A signed-in tab with an empty cache."""
    page = browser.new_context(viewport={"width": 1366, "height": 900}).new_page()
    sign_in(page, service)
    return page


def pages(browser: Any, service: Service, done: dict[str, Any], runs: int) -> dict[str, Any]:
    """Weight and first chart of the model's page; weight of the others."""
    model = f"{service.url}/models/{done['model_id']}"
    charts: dict[str, list[float]] = {"cold": [], "warm": []}
    weights: dict[str, Any] = {}
    for _ in range(runs):
        page = opened(browser, service)
        for state in charts:
            page.goto(model)
            charts[state].append(page.evaluate(FIRST_CHART))
            page.wait_for_load_state("networkidle")
            requests, size = page.evaluate(WEIGHT)
            weights[f"model, {state}"] = {"requests": requests, "kB": round(size / 1000, 1)}
        for path in ("/", "/participants/P1", f"/tests/{done['id']}", f"/models/{done['model_id']}/report"):
            page.goto(service.url + path)
            requests, size = page.evaluate(WEIGHT)
            weights[path.split("/")[-1] if "report" in path else path.split("/")[1] or "home"] = {
                "requests": requests, "kB": round(size / 1000, 1),
            }  # fmt: skip
        page.context.close()
    return {"weight": weights, "first_chart_ms": {key: round(statistics.median(v)) for key, v in charts.items()}}


def live(browser: Any, service: Service) -> dict[str, Any]:
    """Frames of data and of the screen, each second of a running test."""
    service.rig.speed = 1.0
    page = opened(browser, service)
    heard: list[dict[str, Any]] = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda text: heard.append(json.loads(text))))
    participant(page, service, "P2")
    start(page)
    page.locator("#age", has_text="ms").wait_for()
    before = sum(message["type"] == "live" for message in heard)
    shown = page.evaluate(FRAMES, LIVE_S * 1000)
    data = sum(message["type"] == "live" for message in heard) - before
    with service.client() as http:
        http.post("/v1/stop")
    page.context.close()
    return {"data_frames_per_s": round(data / LIVE_S, 1), "screen_frames_per_s": round(shown, 1)}


def main() -> None:
    """Measure and say."""
    made = parser(__doc__)
    made.add_argument("--runs", type=int, default=5)
    options = made.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-page-") as folder:
        for service in run_service(Path(folder), Path(folder), WORKER):
            with service.client() as http:
                http.timeout = httpx.Timeout(120)
                http.post("/v1/participants", json={"code": "P1"})
                done = run_test(http, "P1", 120.0)
                http.get(f"/v1/models/{done['model_id']}/diagnosis")
            with sync_playwright() as driver:
                browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
                found = pages(browser, service, done, options.runs) | live(browser, service)
                browser.close()
    print(json.dumps({**found, "runs": options.runs, "load_average": os.getloadavg(), "cores": os.cpu_count()}))


if __name__ == "__main__":
    main()
