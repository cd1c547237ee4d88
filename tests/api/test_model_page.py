"""A model's page: one screen with verdict, measurement, errors, and the one button that the verdict calls for."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.api.browser import chart
from tests.api.conftest import Service, shared_service, signed_in
from tests.api.test_verdict import make_poor
from tests.api.test_why import FATIGUE, MISSING, NOTHING

service = shared_service()
LAPTOP = {"width": 1366, "height": 768}
TREMOR = {**FATIGUE, "effect": "tremor", "name": "Tremor"}
STATES: list[tuple[str, dict[str, Any] | None, str]] = [
    ("nothing missing", NOTHING | {"where": []}, "Approve"),
    ("one effect missing", MISSING | {"add": ["fatigue"]}, "Add this effect"),
    ("two effects missing", MISSING | {"missing": [FATIGUE, TREMOR], "add": ["fatigue", "tremor"]}, "Improve"),
    ("nothing to add yet", MISSING | {"add": []}, "Approve"),
    ("not usable", NOTHING, "Test again"),
]


@pytest.fixture(scope="module")
def browser_client(service: Service) -> Iterator[httpx.Client]:
    with signed_in(service) as client:
        yield client


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    model: str = service.play_test("S1")["model_id"]
    with service.client() as client:
        client.get(f"/v1/models/{model}/diagnosis")
    return model


def in_state(service: Service, model: str, state: str, diagnosis: dict[str, Any] | None) -> str:
    shown = make_poor(service, model) if state == "not usable" else model
    service.context.analyses._store_result(shown, "diagnosis", {"library": {}, **diagnosis} if diagnosis else None)
    return shown


@pytest.mark.parametrize(("state", "diagnosis", "button"), STATES)
def test_the_first_screen_has_the_one_button_that_the_verdict_calls_for(
    service: Service, browser_client: httpx.Client, model: str, state: str, diagnosis: dict[str, Any], button: str
) -> None:
    shown = in_state(service, model, state, diagnosis)
    page = browser_client.get(f"/models/{shown}").text
    first = page.partition('class="first-screen"')[2].partition('class="folds"')[0]
    buttons = re.findall(r'<(?:button|a) class="(?:button )?(?:primary|stimulate) big"[^>]*>([^<]+)', first)
    assert len(buttons) == 1 and buttons[0].startswith(button)
    assert "<details open" not in page and not re.search(r"<details[^>]* open", page), "all else is closed"


@pytest.mark.browser
def test_it_fits_a_small_laptop(tab: Any, service: Service, model: str) -> None:
    tab.set_viewport_size(LAPTOP)
    for state, diagnosis, _button in (STATES[0], STATES[2], STATES[4]):
        tab.goto(f"{service.url}/models/{in_state(service, model, state, diagnosis)}")
        chart(tab, "overview")
        bottom = tab.evaluate("document.querySelector('.first-screen').getBoundingClientRect().bottom + scrollY")
        assert bottom <= LAPTOP["height"], state
