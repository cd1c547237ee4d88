"""The same record gives the same model: after a nudge far below any sensor's last digit, and on another processor."""

from __future__ import annotations

import json
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.harness import answers

pytestmark = pytest.mark.slow

NUDGE = 1.0 + 1e-9
MOST = 0.01
"""Share of what a plain fit leaves, by which its prediction may move."""
QUICK = ("fatigue", "arm 4 without rest")
"""Records of every run; a campaign takes them all."""

Answers = dict[str, dict[str, Any]]


@cache
def answered(where: str, names: tuple[str, ...]) -> Answers:
    if where == "another processor":
        return answers.answers_elsewhere()
    some = {name: answers.records()[name] for name in names or answers.records()}
    with patch.object(answers, "records", lambda: some):
        return json.loads(json.dumps(answers.answers(NUDGE if where == "nudged" else 1.0)))


@pytest.mark.parametrize(
    ("where", "names"),
    [
        ("nudged", QUICK),
        pytest.param("nudged", (), marks=pytest.mark.campaign),
        pytest.param("another processor", (), marks=pytest.mark.campaign),
    ],
)
def test_the_plain_fit_stays_and_the_same_effects_are_added(where: str, names: tuple[str, ...]) -> None:
    here, again = answered("here", names), answered(where, names)
    moved = {
        name: np.sqrt(np.mean(np.subtract(again[name]["own_nm"], one["own_nm"]) ** 2)) / one["left_nm"]
        for name, one in here.items()
    }
    assert {name: share for name, share in moved.items() if not share <= MOST} == {}
    assert moved.keys() == set(names or answers.records())
    added = [{name: one["added"] for name, one in each.items() if "added" in one} for each in (here, again)]
    assert added[0] == added[1] and "fatigue" in added[0]
