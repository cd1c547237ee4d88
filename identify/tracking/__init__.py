"""Following an approved model from trial to trial: gain, threshold and time scale, with bands."""

from identify.tracking.served import moved_model
from identify.tracking.state import USUAL, Rates, State, Values, updated
from identify.tracking.trial import Seen, look

__all__ = ["USUAL", "Rates", "Seen", "State", "Values", "look", "moved_model", "updated"]
