"""A real browser for the page's tests: tabs that take down every request and error, signed in as the clinician Ada."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.api.conftest import PASSWORD, TOKEN, Service, soon

PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser")
"""The first without windows of its own: with the others each tab costs three times the processor."""
CHROMIUM = next((path for name in PROGRAMS if (path := Path("/usr/bin", name)).exists()), None)
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
WIDE, TABLET, PHONE, ZOOMED = (1280, 860), (820, 1180), (390, 844), (640, 430)
"""ZOOMED: what a window of WIDE shows at 200 %."""
UNCOVERED = """() => { const b = document.getElementById('stop').getBoundingClientRect();
  const at = (x, y) => document.elementFromPoint(b.left + b.width * x, b.top + b.height * y);
  return [[.5, .5], [.03, .1], [.97, .9]].every(([x, y]) => at(x, y)?.id === 'stop'); }"""
"""Nothing lies over the stop button."""
NAME = "Ada"


def watched(browser: Any, **options: Any) -> Any:
    """A tab that takes down every request, error and console message."""
    # a color on its way to another one is neither of the two
    context = browser.new_context(viewport={"width": WIDE[0], "height": WIDE[1]}, reduced_motion="reduce", **options)
    context.set_default_timeout(120_000)  # a busy machine is slow
    page = context.new_page()
    page.requests, page.errors = [], []
    page.on("request", lambda request: page.requests.append(request.url))
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("console", lambda message: page.errors.append(message.text) if message.type == "error" else None)
    return page


def open_tab(browser: Any, service: Service, signed_in: bool = True, **options: Any) -> Iterator[Any]:
    """A tab, signed in; at its end the rig is brought to rest and re-armed."""
    service.rig.confirms_stop = True
    page = watched(browser, **options)
    if signed_in:
        enter(page, service)
    yield page
    close(page.context)
    bring_to_rest(service)


def close(context: Any) -> None:
    """Each page brought to rest first: chromium never closes a context one of whose pages is loading the next one."""
    for page in context.pages:
        try_until(lambda page=page: page.goto("about:blank"), lambda page=page: page.url == "about:blank")
    context.close()


def try_until(do: Callable[[], Any], done: Callable[[], bool]) -> None:
    """Do it until it is done; a page may go elsewhere meanwhile by itself."""
    from playwright.sync_api import Error

    end = time.monotonic() + 90
    while not done():
        assert time.monotonic() < end
        with suppress(Error):
            do()


def bring_to_rest(service: Service) -> None:
    """Whatever it does, stopped; then re-armed."""
    with service.client() as http:
        http.post("/v1/stop")
        soon(lambda: not http.get("/v1/rig").json()["holder"] and service.rig.state != "running", 60)
        rearmed = http.post("/v1/rearm")
        assert rearmed.status_code == 200, rearmed.text


def enter(page: Any, service: Service, name: str = NAME, password: str = PASSWORD) -> None:
    """With a session from outside, on the first page: tests/api/test_day_by_keys.py signs in as people do."""
    with service.client() as http:
        http.post("/v1/users", json={"name": name, "password": password})
    with service.client(None) as http:
        answer = http.post("/v1/sessions", data={"name": name, "password": password})
        assert answer.status_code == 303, answer.text
        cookies = [{"name": key, "value": value, "url": service.url} for key, value in http.cookies.items()]
    page.context.add_cookies(cookies)
    page.goto(service.url + "/")


def sign_in_with_token(page: Any, service: Service) -> None:
    """As the administrator of the first set-up."""
    page.goto(f"{service.url}/sign-in#token={TOKEN}")
    page.get_by_role("button", name="Sign in with the token").click()
    there(page, "Participants")


def chart(page: Any, name: str) -> Any:
    """A chart's still, once it has been scrolled to and is there."""
    page.locator(f"[data-figure={name}]").first.scroll_into_view_if_needed()
    still = page.locator(f"[data-figure={name}] > svg.still").first
    still.wait_for()
    return still


def settled(page: Any) -> None:
    """Wait until the page follows no work at whose end it would load itself anew."""
    follows = page.locator("[data-job], [data-next-key^=identifying]")
    for _ in range(2):  # one that is half loaded has nothing yet
        page.wait_for_load_state()
        expected(follows).to_have_count(0)


def look_closer(page: Any, *names: str) -> None:
    """Take hold of charts: each is drawn by the plot library in its still's place."""
    for name in names:
        chart(page, name)
        page.locator(f"[data-figure={name}] .chart-tools button").click()
        page.locator(f"[data-figure={name}] .modebar-btn").first.wait_for()


def participant(page: Any, service: Service, code: str) -> None:
    page.goto(service.url + "/")
    page.get_by_label("Code").fill(code)
    page.get_by_role("button", name="Create").click()
    there(page, code)


def start(page: Any) -> None:
    """As a clinician does: press *Start*, read what is about to happen, say yes."""
    page.get_by_role("button", name="Start the pre-session test").click()
    page.get_by_role("button", name="Start now").click()
    page.wait_for_url("**/tests/T*")


def without_values(text: str) -> str:
    """A page but for its fields' values: a random token has any two letters now and then."""
    return re.sub(r'value="[^"]*"', "", text)


def there(page: Any, heading: str) -> None:
    """Wait for the page that a click leads to: its heading is seen before its end has come and its scripts run."""
    page.get_by_role("heading", name=heading, exact=True).wait_for()
    page.wait_for_load_state()


def gone(locator: Any) -> None:
    """Wait until there is no such element: the page before may have had it, with the words that were waited for."""
    expected(locator).to_have_count(0)


def expected(locator: Any) -> Any:
    """What is to be true of it soon, on whichever page: a script of ours would fail on a page that is half loaded."""
    from playwright.sync_api import expect

    expect.set_options(timeout=120_000)
    return expect(locator)


def after_the_end(page: Any, where: str, link: str) -> None:
    """From a test that ends to what comes of it: its page leads there, or offers a link where it was loaded late."""

    def go_on() -> None:
        late = page.get_by_role("link", name=link, exact=True)
        if late.count():
            late.click(timeout=2000)
        page.wait_for_timeout(100)

    try_until(go_on, lambda: where in page.url)
    page.wait_for_load_state()


PAINTED = """(id) => { const c = document.getElementById(id);
  const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  let n = 0; for (let i = 3; i < d.length; i += 4) if (d[i]) n++; return n; }"""


def painted_soon(page: Any, canvas: str) -> int:
    """Return how many pixels of a canvas are not empty, once the first frames have been drawn."""
    return soon(lambda: (count := page.evaluate(PAINTED, canvas)) > 3000 and count, 15)
