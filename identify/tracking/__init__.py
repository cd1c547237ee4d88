"""Following an approved model from trial to trial: gain, threshold and time scale, with bands."""

from stimrig.identify.tracking.follow import Outcome, Step, Tracked, follow, model_for_next, track
from stimrig.identify.tracking.state import State

__all__ = ["Outcome", "State", "Step", "Tracked", "follow", "model_for_next", "track"]
