"""The simulator itself: the same seed lives the same life, mistakes are found, and some lives of each kind hold."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest

from stimrig.rig import gate
from stimrig.rig.acquire.run import Halt
from stimrig.rig.gate import Gate
from stimrig.rig.limits import admit
from tests.simulator.__main__ import live, shrink
from tests.simulator.invariants import broken
from tests.simulator.life import Life

SEEDS = range(500_000, 500_024)
"""Lives that no rig was mended on; `make simulate` lives thousands more."""


@pytest.mark.parametrize("seed", SEEDS)
def test_a_life_holds(seed: int):
    life, wrong = live(seed)
    assert wrong == []
    assert life.felt, "a life without a pulse shows little"


def test_the_same_seed_lives_the_same_life_whatever_the_hash_seed():
    code = "from tests.simulator.__main__ import outcome_of; print(outcome_of(500_001).digest)"
    digests = {
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(digests) == 1


def test_a_mistake_is_found_and_shrunk(monkeypatch: pytest.MonkeyPatch):
    """A gate that stays open after a halt: pulses follow a stop."""
    monkeypatch.setattr(Gate, "shut", lambda _gate: None)
    monkeypatch.setattr(Halt, "set", lambda halt, cause, _reason: setattr(halt, "cause", halt.cause or cause) is None)
    seed = next(seed for seed in range(1, 60) if live(seed)[1])
    only = shrink(seed)
    assert live(seed, only)[1]
    assert len(only) < Life(seed).accidents or not only


def wrong_output(of: Any, pulse: Any, *more: Any) -> Any:
    return admit(of, pulse, *more[:-1], 0)


def test_a_pulse_on_the_wrong_output_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "admit", wrong_output)
    several = [seed for seed in range(1, 80) if Life(seed).channels]
    assert any("stands in no file" in " ".join(live(seed)[1]) for seed in several)


@pytest.mark.parametrize("mistaken", [False, True])
def test_pulses_that_do_not_wait_for_other_channels_are_found(monkeypatch: pytest.MonkeyPatch, mistaken: bool) -> None:
    """A line that stands still again and again holds one pulse at most, of whichever channel."""
    if mistaken:
        monkeypatch.setattr(Gate, "_too_close", lambda *_: "")
    wrong: list[str] = []
    for seed in [seed for seed in range(1, 40) if Life(seed).channels][:4]:
        life = Life(seed, only=())
        for tenth in range(80):
            life.world.at(tenth / 10, lambda life=life: life.wires.to_device.stall(0.05, False))
        life.live()
        wrong += broken(life)
    assert any("channels_never_flow_together" in words for words in wrong) == bool(wrong) == mistaken
