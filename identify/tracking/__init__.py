"""Following an approved model from trial to trial: gain, threshold and time scale, with bands."""

from stimrig.identify.tracking.follow import (
    Outcome,
    Step,
    begin,
    follow,
    levels_of,
    model_for_next,
    moved_model,
    passed,
    slow_forms,
)  # fmt: skip
from stimrig.identify.tracking.state import QUANTITIES, USUAL, State, Values, learn_rates

__all__ = [
    "QUANTITIES", "USUAL", "Outcome", "State", "Step", "Values", "begin", "follow", "learn_rates", "levels_of",
    "model_for_next", "moved_model", "passed", "slow_forms",
]  # fmt: skip
