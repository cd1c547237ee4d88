"""The simulator itself: the same seed lives the same life, mistakes are found, and some lives of each kind hold."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from stimrig.rig.acquire.run import Halt
from stimrig.rig.gate import Gate
from tests.simulator.__main__ import live, outcome_of, shrink
from tests.simulator.life import Life

SEEDS = range(500_000, 500_012)
"""Lives that no rig was mended on; `make simulate` lives thousands more."""


@pytest.mark.parametrize("seed", SEEDS)
def test_a_life_holds(seed: int):
    life, wrong = live(seed)
    assert wrong == []
    assert life.felt, "a life without a pulse shows little"


def test_the_same_seed_lives_the_same_life_whatever_the_hash_seed():
    code = "from tests.simulator.__main__ import outcome_of; print(outcome_of(500_001).digest, hash('a'))"
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    other = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True, text=True)
    digest, hashed = other.stdout.split()
    assert digest == outcome_of(500_001).digest and hashed != str(hash("a"))


def test_a_mistake_is_found_and_shrunk(monkeypatch: pytest.MonkeyPatch):
    """A gate that stays open after a halt: pulses follow a stop."""
    monkeypatch.setattr(Gate, "shut", lambda _gate: None)
    monkeypatch.setattr(Halt, "set", lambda halt, cause, _reason: setattr(halt, "cause", halt.cause or cause) is None)
    seed = next(seed for seed in range(1, 200) if Life(seed).accidents <= 4 and live(seed)[1])
    only = shrink(seed)
    assert live(seed, only)[1]
    assert len(only) < Life(seed).accidents or not only
