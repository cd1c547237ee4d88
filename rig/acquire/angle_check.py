"""Detects an angle that a test may not have: outside its range, away from its target, still, or not to be believed.

A sensor that slipped by less than the limit on a jump cannot be detected here, nor one that is stuck in a held test.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.rate import RateCheck
from stimrig.rig.acquire.stream import steps_from
from stimrig.rig.limits import Limit
from stimrig.rig.messages import HELD, TestPlan
from stimrig.rig.signals import TRUSTED

FASTEST_RAD_S = 20.0
"""The fastest voluntary flexion of an elbow: while samples are missing it may turn so far."""
MOVED_RAD = 0.01
"""Less is no movement: noise of the sensor, or of an arm that is held."""
LEAVING = 2.0
"""Tolerances by which a joint may leave its target before the test stops."""


class AngleCheck:
    """Checks the samples of one test, block by block.

    Parameters
    ----------
    plan
        What is asked of the angle; of a plan that asks nothing only whether the sensor can be believed.
    table
        The tightest of rig file, profile and plan.
    rate_hz
        Nominal.
    speed
        Rig seconds per real second.
    """

    def __init__(self, plan: TestPlan, table: dict[str, Limit], rate_hz: float, speed: float) -> None:
        self._wanted, self._is_held = plan.angle, plan.kind == HELD
        self._range, self._jump_rad, self._rate_hz = table["angle_rad"], table["angle_jump_rad"].hi, rate_hz
        self.rate = RateCheck("angle sensor", rate_hz, speed)
        self._last: tuple[float, int, float] | None = None
        self._still: tuple[float, float] | None = None
        self._moving = False

    def started(self) -> None:
        """The test has begun: from now on it may not stand still for long. From any thread."""
        self._moving = True

    def fault(self, samples: NDArray[Any]) -> str | None:
        """What is wrong with this block; None: nothing."""
        angle_rad, now_s = samples["angle_rad"], float(samples["host_time_s"][-1])
        found = (
            _unreliable(samples)
            or self._jumped(samples)
            or self._outside(angle_rad)
            or self._away(angle_rad)
            or self._stands(angle_rad, now_s)
            or self.rate.fault(len(samples), int(samples["counter"][-1]), now_s)
        )
        self._last = float(angle_rad[-1]), int(samples["counter"][-1]), now_s
        return found

    def _jumped(self, samples: NDArray[Any]) -> str | None:
        """More than the limit between two samples; what could have happened while samples were missing is allowed."""
        angle_rad, counter = samples["angle_rad"], samples["counter"]
        before = self._last or (float(angle_rad[0]), int(counter[0]) - 1, float(samples["host_time_s"][0]))
        steps_rad = np.abs(steps_from(before[0], angle_rad))
        if counter[0] >= 0:
            missing_s = (steps_from(before[1], counter) - 1) / self._rate_hz
        else:
            missing_s = np.maximum(0.0, steps_from(before[2], samples["host_time_s"]) - 0.02)
        worst_rad = float(np.max(steps_rad - FASTEST_RAD_S * missing_s))
        if worst_rad <= self._jump_rad:
            return None
        return (
            f"angle sensor: it jumped by {degrees(worst_rad)} from one sample to the next, at most "
            f"{degrees(self._jump_rad)} can be true; a loose cable, a slipped or a reversed sensor"
        )

    def _outside(self, angle_rad: NDArray[np.float64]) -> str | None:
        if self._wanted is None:
            return None
        bound = self._range
        within = (angle_rad >= bound.lo) & (angle_rad <= bound.hi)
        return None if np.all(within) else f"angle sensor: {outside(float(angle_rad[np.argmin(within)]), bound)}"

    def _away(self, angle_rad: NDArray[np.float64]) -> str | None:
        if self._wanted is None or self._wanted.target_rad is None:
            return None
        target_rad, most_rad = self._wanted.target_rad, LEAVING * self._wanted.tolerance_rad
        near = np.abs(angle_rad - target_rad) <= most_rad
        if np.all(near):
            return None
        return (
            f"angle sensor: the joint is at {degrees(float(angle_rad[np.argmin(near)]))}, it must be held at "
            f"{degrees(target_rad)} ± {degrees(most_rad)}"
        )

    def _stands(self, angle_rad: NDArray[np.float64], now_s: float) -> str | None:
        still_s = None if self._wanted is None or self._is_held else self._wanted.still_s
        if still_s is None or not self._moving:
            return None
        if self._still is None or np.any(np.abs(angle_rad - self._still[1]) >= MOVED_RAD):
            self._still = now_s, float(angle_rad[-1])
        if now_s - self._still[0] <= still_s:
            return None
        return (
            f"angle sensor: no movement for {still_s:g} s, at {degrees(self._still[1])}; the sensor is stuck, or the "
            "joint is not moved"
        )


def _unreliable(samples: NDArray[Any]) -> str | None:
    if not np.all(np.isin(samples["fault"], TRUSTED)):
        return "angle sensor: it reports a fault of its own; check the sensor and its mounting"
    if not np.all(np.isfinite(samples["angle_rad"])):
        return "angle sensor: sent an angle that is not a number (NaN); check its cable"
    return None


def outside(angle_rad: float, bound: Limit) -> str:
    """An angle outside a range, in words; one that is beyond it by a hair is not told as the end itself."""
    beyond_rad = max(bound.lo - angle_rad, angle_rad - bound.hi)
    digits = 1 if beyond_rad >= math.radians(0.1) else 3
    return f"{degrees(angle_rad, digits)} is outside {degrees(bound.lo)} … {degrees(bound.hi)} ({bound.owner})"


def degrees(angle_rad: float, digits: int = 1) -> str:
    """An angle for people."""
    return f"{math.degrees(angle_rad):.{digits}f}°"
