"""One calibration in two tabs: what is pressed on the same sight at once is done once, by the service already."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from stimrig.api.store.holds import LIMITS_TURN
from tests.api.conftest import Service, soon
from tests.api.test_access import csrf, signed_in
from tests.api.test_calibration import WHERE, up

PAGE = "/participants/P017/calibration"


@pytest.fixture
def tab(client: httpx.Client, service: Service, participant: str) -> Iterator[tuple[httpx.Client, dict[str, str]]]:
    """A person's browser and what its page's buttons send, after one train."""
    client.post(WHERE)
    up(client)
    assert service.rig.calibration is not None
    with signed_in(service) as browser:
        yield browser, {"csrf": csrf(browser), "calibration": client.get(WHERE).json()["version"]}


def trains(service: Service) -> int:
    assert service.rig.calibration is not None
    return len(service.rig.calibration.trains)


def at_once(service: Service, press: Any, count: int = 2) -> list[httpx.Response]:
    """Press so often; all requests stand at the turn before the first of them gets it."""
    context = service.app.state.context
    turn, loop = context.holds._turns[LIMITS_TURN], context.rig._task.get_loop()
    asyncio.run_coroutine_threadsafe(turn.acquire(), loop).result(10)
    answers: list[httpx.Response] = []
    pressing = [threading.Thread(target=lambda: answers.append(press())) for _ in range(count)]
    for thread in pressing:
        thread.start()
    soon(lambda: len(turn._waiters or ()) >= count, 20)
    loop.call_soon_threadsafe(turn.release)
    for thread in pressing:
        thread.join(20)
    return answers


@pytest.mark.parametrize("direction", ["repeat", "up", "fine"])
def test_two_presses_at_once_send_exactly_one_train(service: Service, tab: Any, direction: str) -> None:
    browser, fields = tab
    answers = at_once(service, lambda: browser.post(f"{PAGE}/step/{direction}", data=fields))
    assert sorted(answer.status_code for answer in answers) == [303, 409] and trains(service) == 2
    (late,) = [answer.text for answer in answers if answer.status_code == 409]
    assert "Another train was sent after this page was shown, or another mark was set. Nothing was done now." in late


def test_nothing_pressed_before_a_train_counts_while_it_is_on_its_way(service: Service, tab: Any) -> None:
    browser, fields = tab
    service.rig_thread.become("running")
    for path in ("step/repeat", "mark/sensory", "finish"):
        answer = browser.post(f"{PAGE}/{path}", data=fields)
        assert answer.status_code == 409 and "Another train was sent" in answer.text, path
    assert trains(service) == 1 and not service.rig.calibration.marks_us  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.parametrize("stale", ["before the marks", "other"])
def test_a_page_that_is_out_of_date_finishes_nothing(
    client: httpx.Client, service: Service, tab: Any, stale: str
) -> None:
    browser, fields = tab
    for threshold in ("sensory", "motor", "comfort"):
        client.post(f"{WHERE}/mark", json={"threshold": threshold})
    version = fields["calibration"] if stale == "before the marks" else "C20260101000000-abc-def.1"
    for what in ("finish", *(("discard", "step/repeat", "mark/motor") if stale == "other" else ())):
        assert browser.post(f"{PAGE}/{what}", data={**fields, "calibration": version}).status_code == 409, what
    assert trains(service) == 1
    assert service.rig.calibration is not None
    now = {**fields, "calibration": client.get(WHERE).json()["version"]}
    assert browser.post(f"{PAGE}/finish", data=now).headers["location"] == "/participants/P017"


def test_the_page_itself_sends_what_it_shows(service: Service, tab: Any) -> None:
    browser, fields = tab
    forms = [part.partition("</form>")[0] for part in browser.get(PAGE).text.split("<form")[1:]]
    own = [form for form in forms if f"{PAGE}/" in form]
    assert len(own) == 3
    assert all(f'name="calibration" value="{fields["calibration"]}"' in form for form in own)
