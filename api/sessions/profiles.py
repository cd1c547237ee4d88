"""Changes of a participant's limits: what stays, what becomes void, what needs a confirmation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from stimrig.api.clock import unix_of
from stimrig.rig.messages import Bound

Profile = Mapping[str, Any]


@dataclass(frozen=True)
class Named:
    """Names of a limit, in a sentence and beside its field, its unit, the rig's name of its bound, and the smallest and
    largest value that any rig takes.

    Below the least there is no limit but a slip: the finest step in which a stimulator tells currents and widths apart,
    and a torque that every muscle at rest has.
    """

    words: str
    label: str
    unit: str
    bound: str
    lowest: float
    highest: float

    def on(self, limits: Mapping[str, Bound]) -> tuple[float, str]:
        """Return the highest value that this rig takes, and who set that; of any rig where this one is unknown."""
        bound = limits.get(self.bound)
        return (self.highest, "any rig's") if bound is None or bound.hi is None else (bound.hi, bound.owner)


LIMITS: dict[str, Named] = {
    "current_ma": Named("current", "Current of every pulse (mA)", "mA", "current_ma", 0.5, 130.0),
    "max_pulse_width_us": Named("comfort maximum", "Comfort maximum (µs)", "µs", "pulse_width_us", 1.0, 500.0),
    "max_torque_nm": Named(
        "torque that stops a test", "Torque that stops a test (N·m)", "N·m", "torque_nm", 0.1, 200.0
    ),
}


def above(values: Profile, limits: Profile, whose: str) -> dict[str, str]:
    """Say of each value that is above its limit by how much, by name; what is no number is above every limit."""
    return {
        name: f"{values[name]:g} {limit.unit} is above {whose} {limits.get(name) or 0.0:g} {limit.unit} by "
        f"{values[name] - (limits.get(name) or 0.0):g}"
        for name, limit in LIMITS.items()
        if name in values and not (values[name] <= (limits.get(name) or 0.0))
    }


CALIBRATION_FIELDS = ("sensory_pulse_width_us", "motor_pulse_width_us", "set_at_utc", "expires_at_utc")
"""Fields of a profile that only a calibration sets."""
JUMP = 1.25
"""More than a quarter above the last value is a jump: a slip of the keyboard is mostly a factor of two or ten."""


def is_calibrated(profile: Profile) -> bool:
    """Return whether the profile holds a calibration, of today or not."""
    return any(profile.get(name) is not None for name in CALIBRATION_FIELDS)


def calibration(profile: Profile, now_utc: str) -> Literal["none", "valid", "expired"]:
    """Return the state of the calibration."""
    if not is_calibrated(profile):
        return "none"
    expires = profile.get("expires_at_utc")
    return "valid" if expires is not None and unix_of(now_utc) < unix_of(expires) else "expired"


def changed(profile: Profile, changes: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the changed profile, and why the calibration is void with it; empty where it stays valid.

    What a calibration found stays where no limit is wider than it was; it goes where one is, and where the comfort
    maximum falls below the motor threshold.
    """
    new = {**profile, **changes}
    if changes.get(RANGE, ...) is None:
        new = {name: value for name, value in new.items() if name not in (RANGE, SET_AT)}
    if not is_calibrated(profile):
        return new, ""
    wider = above(new, profile, "the calibrated")
    voids = [f"{LIMITS[name].words} {words}" for name, words in wider.items()]
    motor_us, width_us = profile.get("motor_pulse_width_us") or 0.0, new["max_pulse_width_us"]
    if not (width_us >= motor_us):
        voids.append(f"the muscle moves from {motor_us:g} µs on, above the new {width_us:g} µs")
    return ({**new, **dict.fromkeys(CALIBRATION_FIELDS)}, voids[0]) if voids else (new, "")


def jumps(profile: Profile, new: Profile) -> list[str]:
    """Describe what rises by more than a quarter: a limit, or the charge of a pulse, to which two small rises add.

    First limits rise from nothing.
    """
    if not profile:
        return []
    figures = [(limit.words, profile[name], new[name], limit.unit) for name, limit in LIMITS.items()]
    charge_figures = ("charge of the widest pulse", charge(profile), charge(new), "µC")
    rises = [figure for figure in figures if not (figure[2] <= JUMP * figure[1])]
    if not rises and not (charge_figures[2] <= JUMP * charge_figures[1]):
        rises = [charge_figures]
    return [
        f"The {words} rises from {was:.4g} to {now:.4g} {unit}, {now / was:.3g} times as much."
        for words, was, now, unit in rises
    ]


def charge(profile: Profile) -> float:
    """Charge of the widest pulse that a profile allows, µC."""
    return profile["current_ma"] * profile["max_pulse_width_us"] * 1e-3


def range_help(name: str, limits: Mapping[str, Bound]) -> str:
    """Describe the range that this rig accepts for a limit, for the help text of its field."""
    highest, owner = LIMITS[name].on(limits)
    return f"at least {LIMITS[name].lowest:g}, at most {highest:g} {LIMITS[name].unit} ({owner})"


def outside(requested: Profile, profile: Profile, limits: Mapping[str, Bound]) -> dict[str, str]:
    """List the requested limits that this rig would refuse: the reason by the limit's name.

    `requested`: the changed limits. `profile`: the participant's limits. `limits`: the rig's own bounds.
    """
    errors = {}
    for name, limit in LIMITS.items():
        highest, owner = limit.on(limits)
        if name in requested and not (limit.lowest <= requested[name] <= highest):
            bounds = f"at least {limit.lowest:g} and at most {highest:g} {limit.unit}"
            errors[name] = f"{requested[name]:g} {limit.unit} is not {bounds}, as this rig asks ({owner})"
    whole, phase = {**profile, **requested}, limits.get("charge_per_phase_uc")
    of_charge = [name for name in ("max_pulse_width_us", "current_ma") if name in requested]
    if not errors and of_charge and phase is not None and phase.hi is not None and not (charge(whole) <= phase.hi):
        above = f"above the {phase.hi:g} µC that this rig takes ({phase.owner})"
        errors[of_charge[0]] = f"with it a pulse carries {charge(whole):.3g} µC, {above}"
    return errors


# The range of joint angles: a straight elbow has the angle 0; flexion is positive. Programs send radians, pages show
# degrees.
RANGE = "angle_range_rad"
"""In a profile: lowest and highest angle that is comfortable today."""
SET_AT = "angle_set_at_utc"
"""In a profile: when the sensor was calibrated under which the range was said."""
LEAST_RAD, MOST_RAD = -math.pi, math.pi
NARROWEST_RAD = math.radians(10)
TOLERANCE_RAD = 0.09
"""Tolerance of a held joint's angle (5°)."""


def rising_range(range_rad: tuple[float, float]) -> tuple[float, float]:
    """Check a range as sent. Raises ValueError: it is no range, or too narrow to move in."""
    low, high = range_rad
    if not (high - low >= NARROWEST_RAD - 1e-9):
        narrowest = f"{math.degrees(NARROWEST_RAD):.0f}° ({NARROWEST_RAD:.2f} rad)"
        raise ValueError(f"the second angle must be at least {narrowest} above the first")
    return range_rad


def range_of(profile: Profile) -> tuple[float, float] | None:
    """Return the participant's range, rad, or None."""
    range_rad = profile.get(RANGE)
    return None if range_rad is None else (float(range_rad[0]), float(range_rad[1]))


def range_outdated(profile: Profile, set_at_utc: str | None) -> bool:
    """Return whether the range was set under another calibration of the angle sensor than that of `set_at_utc`."""
    return range_of(profile) is not None and profile.get(SET_AT) != set_at_utc


def range_within(inner: Sequence[float], outer: Sequence[float] | None) -> bool:
    """Return whether a range lies within another, with a tolerance for rounded degrees."""
    return outer is None or (outer[0] - 1e-6 <= inner[0] and inner[1] <= outer[1] + 1e-6)


def range_words(range_rad: Sequence[float]) -> str:
    """A range for people: 20° … 110°."""
    low, high = (f"{math.degrees(angle):.0f}".replace("-", "−") for angle in range_rad)
    return f"{low}° … {high}°"


def range_outside(requested: Profile, rig_rad: Sequence[float] | None) -> dict[str, str]:
    """Return why this rig would refuse the requested range, by field; empty where it accepts the range."""
    range_rad = range_of(requested)
    if range_rad is None or rig_rad is None or range_within(range_rad, rig_rad):
        return {}
    return {RANGE: f"{range_words(range_rad)} is not within {range_words(rig_rad)}, as this rig asks"}
