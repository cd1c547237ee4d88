"""A record and what improving it gives, that two files of tests look at."""

from __future__ import annotations

from functools import cache

from stimrig import identify
from stimrig.identify.records.record import Record
from stimrig.identify.results import Improvement
from tests.harness import few_effects
from tests.identify import hidden_muscles


def fatigued() -> Record:
    """A muscle that tires."""
    return hidden_muscles.record("fatigue", seed=15, rate_hz=100)


@cache
def improved_with_a_delay() -> Improvement:
    """Its fatigue is found; a delay that it hasn't is asked for."""
    with few_effects.only("electromechanical_delay", "fatigue", "potentiation", "recruitment_hysteresis"):
        return identify.improve(fatigued(), force=["electromechanical_delay"])
