"""`python -m bench.page [--runs N]`: what pages weigh, when a first chart is there, how long each page takes.

Service, real workers and a fake rig (`tests/api/fake_rig.py`) on this machine, Debian's chromium. *Cold*: an empty
cache; *warm*: the cache of the page before. Pages are timed with a participant of many sessions, whose rows are copies
of one test's with other days.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import sync_playwright
from sqlalchemy import select

from bench.common import bench_parser
from stimrig.api.jobs.worker import Worker
from stimrig.api.store.tables import Analysis, Approval, Model, Note, Participant, Recording, Test
from tests.api.browser import ARGUMENTS, CHROMIUM, NAME, PASSWORD
from tests.api.conftest import Service, run_service, run_test

WEIGHT = """() => {
  const all = ['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind));
  return [all.length, all.reduce((sum, entry) => sum + entry.transferSize, 0)]; }"""
FIRST_CHART = """() => new Promise((done) => {
  const look = () => document.querySelector('.main-svg .scatterlayer path, [data-figure=overview] svg.still path')
    ? done(performance.now()) : requestAnimationFrame(look);
  look(); })"""
LOADED = "() => performance.getEntriesByType('navigation')[0].loadEventEnd"
SESSIONS = 200


def opened(browser: Any, service: Service) -> Any:
    """A signed-in tab with an empty cache."""
    with service.client() as http:
        http.post("/v1/users", json={"name": NAME, "password": PASSWORD})
    with service.client(None) as http:
        http.post("/v1/sessions", data={"name": NAME, "password": PASSWORD})
        cookies = [{"name": key, "value": value, "url": service.url} for key, value in http.cookies.items()]
    context = browser.new_context(viewport={"width": 1366, "height": 900})
    context.add_cookies(cookies)
    return context.new_page()


def seed(service: Service, done: dict[str, Any]) -> list[str]:
    """A participant with many sessions, each a copy of the test's rows with a day of its own; ids of the models."""
    store = service.context.store
    with store.read() as session:
        rows = [session.get(Participant, "P1"), session.get(Recording, done["recording_id"]),
                session.get(Test, done["id"]), session.get(Model, done["model_id"])]  # fmt: skip
        stored_analyses = session.scalars(select(Analysis).where(Analysis.model_id == done["model_id"])).all()
        whole, recording, test, model = (row.as_dict() for row in rows if row is not None)
        analyses = [row.as_dict() for row in stored_analyses]
    ids = []
    with store.write() as session:
        session.add(Participant(**{**whole, "code": "P200"}))
        for k in range(SESSIONS):
            day = f"{datetime.now(UTC) - timedelta(days=SESSIONS - k):%Y-%m-%dT%H:%M:%S.000Z}"
            ids.append(f"{model['id'][:-4]}{k:04d}")
            names = {"recording_id": f"r{k:04d}", "test_id": f"t{k:04d}", "model_id": ids[-1]}
            at = {"participant": "P200", "created_utc": day}
            session.add(Recording(**{**recording, **at, "id": names["recording_id"], "test_id": names["test_id"]}))
            session.add(Test(**{**test, "participant": "P200", "id": names["test_id"], "requested_utc": day,
                                "recording_id": names["recording_id"], "model_id": names["model_id"]}))  # fmt: skip
            session.flush()
            session.add(Model(**{**model, **at, "id": ids[-1], "recording_id": names["recording_id"]}))
            session.flush()
            session.add_all(Analysis(**{**row, "model_id": ids[-1]}) for row in analyses)
            session.add(Approval(model_id=ids[-1], participant="P200", approved=True, by="Ada", at_utc=day))
            session.add(Note(id=f"n{k:04d}", participant="P200", kind="posture", text="sat a little lower than before",
                             by="Ada", at_utc=day, test_id=names["test_id"]))  # fmt: skip
    return ids


def times(browser: Any, service: Service, ids: list[str], runs: int) -> dict[str, Any]:
    """Until each page has loaded, ms: the middle and the 95th percentile, with a warm cache."""
    newest, page = f"/models/{ids[-1]}", opened(browser, service)
    paths = {
        "home": "/", "participant": "/participants/P200", "model": newest + "?diagnose=0", "report": newest + "/report",
        "trend": "/participants/P200/trend",
        "test": f"/tests/t{SESSIONS - 1:04d}", "administration": "/administration",
    }  # fmt: skip
    by_page = {}
    for name, path in paths.items():
        took = []
        for _ in range(runs + 1):
            page.goto(service.url + path)
            took.append(page.evaluate(LOADED))
        warm = sorted(took[1:])
        size = page.evaluate(WEIGHT)[1]
        p95_ms = round(warm[int(0.95 * (runs - 1) + 0.5)])
        by_page[name] = {"median_ms": round(statistics.median(warm)), "p95_ms": p95_ms, "kB": round(size / 1000, 1)}
    page.context.close()
    return by_page


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
            page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
            for box in page.locator("[data-figure]").all():
                box.scroll_into_view_if_needed()
                page.wait_for_timeout(200)
            requests, size = page.evaluate(WEIGHT)
            weights[f"model, {state}, all charts seen"] = {"requests": requests, "kB": round(size / 1000, 1)}
        for path in ("/", "/participants/P1", f"/tests/{done['id']}", f"/models/{done['model_id']}/report"):
            page.goto(service.url + path)
            requests, size = page.evaluate(WEIGHT)
            weights[path.split("/")[-1] if "report" in path else path.split("/")[1] or "home"] = {
                "requests": requests, "kB": round(size / 1000, 1),
            }  # fmt: skip
        page.context.close()
    return {"weight": weights, "first_chart_ms": {key: round(statistics.median(v)) for key, v in charts.items()}}


def main() -> None:
    """Measure and say."""
    parser = bench_parser(__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--looks", type=int, default=20, help="at each page of the participant with many sessions")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-page-") as folder:
        for service in run_service(Path(folder), Path(folder), Worker):
            with service.client() as http:
                http.timeout = httpx.Timeout(120)
                http.post("/v1/participants", json={"code": "P1"})
                done = run_test(http, "P1", 120.0)
                http.get(f"/v1/models/{done['model_id']}/diagnosis")
                http.get(f"/models/{done['model_id']}")
            with sync_playwright() as driver:
                browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
                figures = pages(browser, service, done, options.runs)
                figures |= {"page_ms": times(browser, service, seed(service, done), options.looks)}
                browser.close()
            figures |= {"runs": options.runs, "load_average": os.getloadavg(), "cores": os.cpu_count()}
            print(json.dumps(figures))


if __name__ == "__main__":
    main()
