"""Records, fits and diagnoses that several files of tests look at."""

from __future__ import annotations

from functools import cache

from stimrig import identify
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis, Improvement
from tests.harness import few_effects
from tests.identify import hidden_muscles


@cache
def diagnosed(hidden: str, seed: int, ar1: float = 0.0) -> Diagnosis:
    """Of a muscle with something hidden in it, or nothing."""
    return identify.diagnose(hidden_muscles.record(hidden, seed=seed, ar1=ar1))


def fatigued() -> Record:
    """A muscle that tires."""
    return hidden_muscles.record("fatigue", seed=15, rate_hz=100)


@cache
def improved_with_a_delay() -> Improvement:
    """Its fatigue is found; a delay that it hasn't is asked for."""
    with few_effects.only("electromechanical_delay", "fatigue", "potentiation", "recruitment_hysteresis"):
        return identify.improve(fatigued(), force=["electromechanical_delay"])
