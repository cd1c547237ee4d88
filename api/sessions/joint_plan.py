"""The three guided tests of a joint that moves: which angles, which widths, for how long, at what torque-time. Pure.

Together they cost at most what the default test costs: a part of what that one is expected to take is shared out, and
each staircase and each steady level is as long as its share allows. All is counted with the same recruitment curve at
the angle of the isometric test; how the torque changes with angle and velocity is what these tests are to find out, and
the part that is not planned is there for a muscle that is stronger elsewhere.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.api.sessions.profiles import TOLERANCE_RAD
from stimrig.rig.messages import HELD, MOVING, PASSIVE

KINDS = (PASSIVE, HELD, MOVING)
"""Kinds of guided tests."""
ROUND_RAD = math.radians(5)
"""Angles to hold are whole multiples: a goniometer is read so."""
LEAST_RANGE_RAD = math.radians(30)
"""A smaller range has no three angles that can be told apart."""
RANGES_RAD = (math.radians(60), math.radians(90))
"""From the first on there are four angles to hold, from the second on five."""

PLANNED_SHARE = 0.85
"""Share of the default test's torque-time: the worst of 60 simulated arms took 1.15 times the planned dose."""
HELD_SHARE = 0.45
"""Share of the planned dose for all held tests together; the moving test has the rest."""
STAIRS = (0.25, 0.5, 0.75)
"""Steps of a held test, as shares of the torque at the widest pulse."""
LONGEST_STAIR_S = 1.0
LEVELS = (0.6, 0.3)
"""Steady levels of a moving test, as shares of that torque, one after the other."""
LEVEL_S, PAUSE_S = 4.0, 1.5
RISE_S = 0.3
"""From one width to the next: no jump that startles."""
QUIET_S = 1.0
"""Without stimulation, before and after the steps of a held test, and before the first level of a moving one."""
LONGEST_S = {PASSIVE: 90.0, MOVING: 60.0}
"""The longest passive and moving test, where nobody says."""
STILL_S = {PASSIVE: 8.0, MOVING: 5.0}
"""So long the joint may stand still before such a test ends: then nobody moves it, or the sensor is stuck."""
SEEN_S = {PASSIVE: 0.2, MOVING: 0.1}
"""Time in a cell of angle and velocity after which it counts as seen."""
UNKNOWN_MOTOR_SHARE = 0.3
"""Assumed motor threshold as a share of the widest pulse, without a model or a calibration."""

Segment = dict[str, Any]


@dataclass(frozen=True)
class Curve:
    """Steady torque over pulse width, rising: a model's, or a stand-in whose torque at the widest pulse is 1."""

    pulse_width_us: Sequence[float]
    torque_nm: Sequence[float]
    known: bool  # whether it is a model's, in N·m

    def torque(self, width_us: Any) -> Any:
        """Steady torque at a width, or at each of several; 0 without a pulse, level beyond the ends."""
        return np.where(np.asarray(width_us) > 0.0, np.interp(width_us, self.pulse_width_us, self.torque_nm), 0.0)

    def width(self, torque_nm: float, largest_us: float) -> float:
        """The smallest width that gives a torque, in steps of a µs; never above the largest."""
        return float(np.searchsorted(self.torque(np.arange(math.floor(largest_us))), torque_nm))

    def torque_time(self, segments: Sequence[Segment], rate_hz: float) -> float:
        """Expected torque-time of segments, N·m·s (with a stand-in: s at the torque of the widest pulse)."""
        return float(np.sum(self.torque(widths_of(segments)))) / rate_hz


def curve_of(table: Mapping[str, Sequence[float]] | None, largest_us: float, motor_us: float | None) -> Curve:
    """The approved model's recruitment curve; where there is none, a straight line from the motor threshold on.

    `table`: `pulse_width_us` and `torque_nm`; one without torque at the widest pulse is not used. `largest_us`: the
    widest pulse of the tests, µs; `motor_us`: what the calibration found, µs.
    """
    if table is not None:
        curve = Curve(table["pulse_width_us"], np.maximum(0.0, table["torque_nm"]).tolist(), True)
        if len(curve.torque_nm) > 1 and curve.torque(largest_us) > 0.0:
            return curve
    begin_us = motor_us if motor_us is not None and 0 < motor_us < largest_us else UNKNOWN_MOTOR_SHARE * largest_us
    return Curve((begin_us, largest_us), (0.0, 1.0), False)


def targets(range_rad: Sequence[float]) -> list[float]:
    """The angles to hold, rad: 3 to 5, evenly over the range, far enough from its ends that none is left by accident.

    Each is rounded to a multiple of 5° that lies in the range. Empty where the range is too small.
    """
    low, high = range_rad
    width = high - low
    if not (width >= LEAST_RANGE_RAD - 1e-9):
        return []
    count = 3 + sum(width >= edge - 1e-9 for edge in RANGES_RAD)
    margin = min(2.0 * TOLERANCE_RAD, width / 6)
    first, last, angles = low + margin, high - margin, []
    for angle in np.linspace(first, last, count).tolist():
        near = round(angle / ROUND_RAD) * ROUND_RAD
        rounded = (near, near + ROUND_RAD, near - ROUND_RAD, angle)
        angles.append(next(each for each in rounded if first - 1e-9 <= each <= last + 1e-9))
    return angles


def held(curve: Curve, largest_us: float, stair_s: float, rate_hz: float) -> list[Segment]:
    """Return a short staircase with rest around it."""
    segments, before_us = [still("rest", QUIET_S, rate_hz)], 0.0
    for number, share in enumerate(STAIRS, start=1):
        width_us = curve.width(share * curve.torque(largest_us), largest_us)
        segments.append(_level(f"hold {number}", before_us, width_us, stair_s, rate_hz))
        before_us = width_us
    return [*segments, still("rest", QUIET_S, rate_hz)]


def moving(curve: Curve, largest_us: float, most_nm_s: float, longest_s: float, rate_hz: float) -> list[Segment]:
    """Steady levels with pauses, until their torque-time or the time is used up."""
    segments = [still("passive", QUIET_S, rate_hz)]
    left_nm_s, left_s, number = most_nm_s, longest_s - QUIET_S, 0
    while True:
        width_us = curve.width(LEVELS[number % len(LEVELS)] * curve.torque(largest_us), largest_us)
        hold_s = min(LEVEL_S, left_nm_s / max(curve.torque(width_us), 1e-9), left_s)
        if hold_s < 2 * RISE_S:
            return segments
        number += 1
        level = _level(f"moving {number}", 0.0, width_us, hold_s, rate_hz)
        left_nm_s -= curve.torque_time([level], rate_hz)
        left_s -= hold_s + PAUSE_S
        segments += [level, still("passive", PAUSE_S, rate_hz)]


def _level(name: str, before_us: float, width_us: float, hold_s: float, rate_hz: float) -> Segment:
    """A width that is held, reached from the one before it within the time of a rise."""
    count, rise = math.floor(hold_s * rate_hz + 1e-6), max(round(RISE_S * rate_hz), 1)
    widths = np.interp(np.arange(1, count + 1), [0, rise], [before_us, width_us])
    return _segment(name, (np.floor(10.0 * widths) / 10.0).tolist())


def still(name: str, seconds: float, rate_hz: float) -> Segment:
    """No pulse at all."""
    return _segment(name, [0.0] * max(round(seconds * rate_hz), 1))


def _segment(name: str, widths_us: list[float]) -> Segment:
    return {"name": name, "sequence": "widths", "settings": {"pulse_width_us": widths_us}}


def widths_of(segments: Sequence[Segment]) -> list[float]:
    """All pulses of segments of this module, µs."""
    return [width for segment in segments for width in segment["settings"]["pulse_width_us"]]


@dataclass(frozen=True)
class Layout:
    """The guided tests of a participant."""

    targets_rad: list[float]  # angles to hold
    held: list[Segment]  # of one held test
    moving: list[Segment]
    doses: dict[str, float]
    """Expected torque-time: of the default test, one held test, all of them, the moving one, and all together; N·m·s,
    with a stand-in curve only good for being compared."""
    known: bool  # whether the doses are N·m·s

    @property
    def share(self) -> float:
        """Share of the default test's torque-time."""
        return self.doses["total"] / self.doses["paper"] if self.doses["paper"] > 0 else 0.0


def layout(
    range_rad: Sequence[float], curve: Curve, largest_us: float, default_us: Sequence[float], rate_hz: float,
    moving_s: float = LONGEST_S[MOVING],
) -> Layout:  # fmt: skip
    """Share out `PLANNED_SHARE` of the default test's torque-time among the held tests and the moving one.

    `range_rad`: the participant's lowest and highest angle, rad; `default_us`: every width of the default test with
    these limits, µs; `moving_s`: the longest moving test without its safe end, s.
    """
    angles = targets(range_rad)
    default_nms = float(np.sum(curve.torque(default_us))) / rate_hz
    full = curve.torque_time(held(curve, largest_us, LONGEST_STAIR_S, rate_hz), rate_hz)
    fits = HELD_SHARE * PLANNED_SHARE * default_nms / (full * len(angles)) if angles and full > 0 else 0.0
    stairs = held(curve, largest_us, LONGEST_STAIR_S * min(1.0, fits), rate_hz)
    each = curve.torque_time(stairs, rate_hz)
    left = max(PLANNED_SHARE * default_nms - each * len(angles), 0.0)
    levels = moving(curve, largest_us, left, moving_s, rate_hz)
    doses = {
        "paper": default_nms,
        "held_each": each,
        "held": each * len(angles),
        "moving": curve.torque_time(levels, rate_hz),
    }
    return Layout(angles, stairs, levels, doses | {"total": doses["held"] + doses["moving"]}, curve.known)


SLOW_RAD_S, FAST_RAD_S = 0.15, 0.7
"""A movement slower than the first is none; from the second on it is a fast one (40°/s)."""
VELOCITY_EDGES_RAD_S = (-FAST_RAD_S, -SLOW_RAD_S, SLOW_RAD_S, FAST_RAD_S)
ROWS = (("extension", "fast"), ("extension", "slow"), None, ("flexion", "slow"), ("flexion", "fast"))
"""Direction and speed of each row of velocities; None: nearly still."""
MISSING_ORDER = (3, 1, 4, 0)
"""Rows as they are to be done: slow before fast, flexion before extension."""
BIN_RAD = math.radians(15)
LEAST_BINS, MOST_BINS = 3, 8
MARGIN_RAD, MARGIN_SHARE = math.radians(3), 0.05
"""Left out at each end of the range: whoever leaves the range ends the test."""
LONGEST_STEP_S = 0.05
"""A longer gap between two samples says nothing of the cells between them."""
ENOUGH = 0.9
"""Share of the cells that are asked for: at most a tenth is missing when a test ends."""


class Coverage:
    """Time of the joint in each cell of angle and velocity: fast and slow in both directions, and nearly still.

    A cell is seen once the joint was in it for long enough. Nearly still is not needed, nor fast at the ends of the
    range, where a movement turns round. The columns of angle are of about 15°, from 3 to 8 of them.

    `range_rad`: lowest and highest angle; `seen_s`: time in a cell after which it is seen.
    """

    def __init__(self, range_rad: Sequence[float], seen_s: float) -> None:
        low, high = range_rad
        margin = max(MARGIN_RAD, MARGIN_SHARE * (high - low))
        first, last = (low + margin, high - margin) if high - low > 4 * margin else (low, high)
        self.columns = min(max(round((last - first) / BIN_RAD), LEAST_BINS), MOST_BINS)
        self.edges_rad = np.linspace(first, last, self.columns + 1)
        self.seen_s, self.time_s = seen_s, np.zeros((len(ROWS), self.columns))
        self.needed = np.zeros(self.time_s.shape, bool)
        for row, kind in enumerate(ROWS):
            self.needed[row, :] = kind is not None
            if kind is not None and kind[1] == "fast":
                self.needed[row, [0, -1]] = False
        self._last_s: float | None = None

    def add(self, time_s: float, angle_rad: float, velocity_rad_s: float, counts: bool = True) -> None:
        """Add a sample; one that does not count (no stimulation, say) only moves the time on.

        A sample that is no number is left out. Angles beyond the edges belong to the outer columns.
        """
        if not math.isfinite(time_s + angle_rad + velocity_rad_s):
            return
        last_s, self._last_s = self._last_s, time_s
        if not counts or last_s is None or not (0.0 < time_s - last_s <= LONGEST_STEP_S):
            return
        column = bisect_right(self.edges_rad[1:-1], angle_rad)
        self.time_s[bisect_right(VELOCITY_EDGES_RAD_S, velocity_rad_s), column] += time_s - last_s

    @property
    def covered(self) -> Any:
        """Return for each cell whether the joint was in it for long enough; a hair less, for sums of samples."""
        return self.time_s >= self.seen_s - 1e-6

    @property
    def share(self) -> float:
        """Share of the needed cells that are covered, 0 to 1."""
        return float(np.mean(self.covered[self.needed]))

    @property
    def enough(self) -> bool:
        """Return whether a test may end."""
        return self.share >= ENOUGH - 1e-9

    def missing(self) -> list[dict[str, Any]]:
        """Return the stretches of angles that were not seen yet in a direction at a speed."""
        stretches, missing = [], self.needed & ~self.covered
        for row in MISSING_ORDER:
            direction, speed = ROWS[row] or ("", "")
            ends = np.flatnonzero(np.diff(missing[row].astype(int), prepend=0, append=0)).reshape(-1, 2)
            for from_rad, to_rad in self.edges_rad[ends].tolist():
                stretches.append({"direction": direction, "speed": speed, "from_rad": from_rad, "to_rad": to_rad})
        return stretches

    def document(self) -> dict[str, Any]:
        """Return it as clients see it."""
        return {
            "angle_edges_rad": self.edges_rad.round(4).tolist(),
            "velocity_edges_rad_s": list(VELOCITY_EDGES_RAD_S),
            "time_s": self.time_s.round(3).tolist(),
            "asked": self.needed.tolist(),
            "seen_s": self.seen_s,
            "share": round(self.share, 4),
            "enough": self.enough,
            "missing": self.missing(),
        }
