"""How the elbow moves, and the protocol of whatever moves it.

Angle 0 is the straight arm, flexion is positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

from stimrig.hardware_sim.errors import ArmError

SMALLEST_DEG, LARGEST_DEG = -10.0, 160.0
"""What an elbow can be asked for; people reach -5 to 150 degrees."""
SLOWEST_DEG_S, FASTEST_DEG_S = 0.1, 1000.0


class Motion(NamedTuple):
    """Angle, rad, its velocity, rad/s, and its acceleration, rad/s²."""

    angle_rad: float
    velocity_rad_s: float = 0.0
    acceleration_rad_s2: float = 0.0


class Begin(NamedTuple):
    """Where a mover takes over: the time, the motion then, and the seed of all that is random about it."""

    time_s: float
    motion: Motion
    seed: int = 0


Drive = Callable[[float, float], float]
"""Angular acceleration of a forearm that nobody holds, rad/s², at an angle, rad, and a velocity, rad/s."""


class MoverProtocol(Protocol):
    """Holds the forearm, moves it, or lets it go.

    Its constructor takes `Begin` and, by keyword, settings with defaults: what the control line and files give.
    """

    holds: bool
    """Whether somebody holds the forearm, so that the load cell between the two carries the torque."""

    def advance(self, time_s: float, drive: Drive) -> Motion:
        """The motion at `time_s`, which never runs backwards; only a mover that does not hold asks the drive."""
        ...


def radians(name: str, degrees: float, low: float = SMALLEST_DEG, high: float = LARGEST_DEG) -> float:
    """A setting in degrees (or degrees/s), checked, in radians.

    Raises
    ------
    ArmError
        It is out of its range.
    """
    return math.radians(within(name, degrees, low, high))


def within(name: str, value: float, low: float, high: float) -> float:
    """A setting, checked.

    Raises
    ------
    ArmError
        It is no number or out of its range.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and low <= value <= high):
        raise ArmError(f"the arm's '{name}' must be between {low:g} and {high:g}, not {value!r}")
    return float(value)
