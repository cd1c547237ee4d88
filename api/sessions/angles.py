"""A participant's range of joint angles: how it is kept, what is refused, and degrees for people.

An elbow that is straight has the angle 0; flexion is positive. Programs send radians, pages show degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

RANGE = "angle_range_rad"
"""In a profile: lowest and highest angle that is comfortable today."""
SET_AT = "angle_set_at_utc"
"""In a profile: when the sensor was calibrated under which the range was said."""
LEAST_RAD, MOST_RAD = -math.pi, math.pi
NARROWEST_RAD = math.radians(10)
TOLERANCE_RAD = 0.09
"""How near to its angle a held joint must be (5°)."""

Profile = Mapping[str, Any]


def rising(range_rad: tuple[float, float]) -> tuple[float, float]:
    """A range as it was sent. Raises ValueError where it is no range, or too narrow to move in."""
    low, high = range_rad
    if not (high - low >= NARROWEST_RAD - 1e-9):
        raise ValueError(f"the second angle must be at least {NARROWEST_RAD:.2f} rad above the first")
    return range_rad


def of(profile: Profile) -> tuple[float, float] | None:
    """The participant's range, rad; None where there is none."""
    found = profile.get(RANGE)
    return None if found is None else (float(found[0]), float(found[1]))


def outdated(profile: Profile, set_at_utc: str | None) -> bool:
    """Whether the range was said under another calibration of the angle sensor than that of `set_at_utc`."""
    return of(profile) is not None and profile.get(SET_AT) != set_at_utc


def within(inner: Sequence[float], outer: Sequence[float] | None) -> bool:
    """Whether a range lies in another one; a hair beyond it does, for degrees that were rounded."""
    return outer is None or (outer[0] - 1e-6 <= inner[0] and inner[1] <= outer[1] + 1e-6)


def words(range_rad: Sequence[float]) -> str:
    """A range for people: 20° … 110°."""
    low, high = (f"{math.degrees(angle):.0f}".replace("-", "−") for angle in range_rad)
    return f"{low}° … {high}°"


def outside(asked: Profile, rig_rad: Sequence[float] | None) -> dict[str, str]:
    """Why this rig would refuse the range that is asked for, by its field; empty where it takes it."""
    range_rad = of(asked)
    if range_rad is None or within(range_rad, rig_rad):
        return {}
    assert rig_rad is not None
    return {RANGE: f"{words(range_rad)} is not within {words(rig_rad)}, as this rig asks"}
