"""The same record gives the same model: after a nudge far below any sensor's last digit, and on another processor."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.harness.answers import IMPROVED, answers, answers_elsewhere, records

pytestmark = pytest.mark.slow

NUDGE = 1.0 + 1e-9
MOST = 0.01
"""Share of what a plain fit leaves, by which its prediction may move."""

Answers = dict[str, dict[str, Any]]


@cache
def answered(where: str) -> Answers:
    if where == "another processor":
        return answers_elsewhere()
    return json.loads(json.dumps(answers(NUDGE if where == "nudged" else 1.0)))


@pytest.fixture
def here() -> Answers:
    return answered("here")


@pytest.fixture(params=["nudged", pytest.param("another processor", marks=pytest.mark.campaign)])
def again(request: pytest.FixtureRequest) -> Answers:
    return answered(request.param)


def test_the_plain_fit_stays(here: Answers, again: Answers) -> None:
    moved = {
        name: np.sqrt(np.mean(np.subtract(again[name]["own_nm"], one["own_nm"]) ** 2)) / one["left_nm"]
        for name, one in here.items()
    }
    assert {name: share for name, share in moved.items() if not share <= MOST} == {}
    assert moved.keys() == records().keys()


@pytest.mark.parametrize("name", IMPROVED)
def test_the_same_effects_are_added(here: Answers, again: Answers, name: str) -> None:
    assert again[name]["added"] == here[name]["added"]
