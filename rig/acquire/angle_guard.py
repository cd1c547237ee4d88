"""Checks of the joint's angle while a test runs, and notes about a sensor that the test does not need.

It detects an angle that a test may not have: outside its range, away from its target, still, or not to be believed. A
sensor that slipped by less than the limit on a jump cannot be detected here, nor one that is stuck in a held test.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.health import Watch
from stimrig.rig.acquire.plausibility import RateCheck
from stimrig.rig.acquire.stream import steps_from
from stimrig.rig.clock import Clock
from stimrig.rig.errors import DeviceError, JournalError, RefusedError
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.limits import Limit, check
from stimrig.rig.messages import HELD, TestPlan
from stimrig.rig.signals import TRUSTED, Recorded
from stimrig.rig.tasks import Tasks

AROUND_S = 0.1
"""Real seconds over which the median tells where the joint is before a test."""
PATIENCE_S = 2.0
"""Real seconds to wait for a sensor that was just plugged in, or a rig that was just started."""
FASTEST_RAD_S = 20.0
"""The fastest voluntary flexion of an elbow: while samples are missing it may turn so far."""
MOVED_RAD = 0.01
"""Less is no movement: noise of the sensor, or of an arm that is held."""
LEAVING = 2.0
"""Tolerances by which a joint may leave its target before the test stops."""


class AngleGuard:
    """The angle sensor during one test. Of a plan that asks nothing only whether the sensor can be believed is noted.

    `receiver`: None: the rig has no angle sensor; `table`: the tightest of rig file, profile and plan.
    """

    def __init__(
        self, receiver: AngleReceiver | None, plan: TestPlan, table: dict[str, Limit], clock: Clock, watch: Watch
    ) -> None:
        self._receiver, self._clock, self._watch = receiver, clock, watch
        self._wanted, self._is_held = plan.angle, plan.kind == HELD
        self._range, self._jump_rad = table["angle_rad"], table["angle_jump_rad"].hi
        self.needed = plan.angle is not None
        """True where a fault of the angle ends the test."""
        self._journal: Journal | None = None
        self._noted = False
        self._rate_hz = 1.0 if receiver is None else receiver.nominal_rate_hz
        self._rate = RateCheck("angle sensor", self._rate_hz, clock.speed)
        self._last: tuple[float, int, float] | None = None
        self._still: tuple[float, float] | None = None
        self._moving = False

    def record(self, journal: Journal, on_fault: Callable[[str], None]) -> None:
        """Write every sample from now on; `on_fault` gets what must end the test."""
        self._journal = journal
        if self._receiver is not None:
            self._receiver.write_to(journal, self._wrong, on_fault if self.needed else self._note, on_fault)

    def release(self) -> Recorded | None:
        return None if self._receiver is None else self._receiver.release()

    def fresh(self) -> bool:
        """Return whether the test may begin: the newest angle is current, or none is needed."""
        return not self.needed or self._stale() is None

    def begin(self) -> None:
        """Begin to measure the rate; call it once the buffers have been read."""
        self._rate.begin()

    def started(self) -> None:
        """The test's clock runs: from now on the joint may not stand still for long. From any thread."""
        self._moving = True

    def fault(self, stood_s: float = 0.0) -> str | None:
        """Return the fault that must end the test, or None; called before each pulse. `stood_s`: see `Health`."""
        return self._ending(self._stale(stood_s))

    def fault_at_end(self) -> str | None:
        """Return the fault that only the whole test shows, or None."""
        return self._ending(self._rate.fault_at_end())

    def _ending(self, fault: str | None) -> str | None:
        """Return the fault if this test needs the sensor; else note it and return None."""
        if fault is not None and not self.needed:
            self._note(fault)
        return fault if self.needed else None

    def _stale(self, stood_s: float = 0.0) -> str | None:
        if self._receiver is None:
            return "angle sensor: this rig has none" if self.needed else None
        age_s = self._receiver.data_age_s(self._clock.now_s()) / self._clock.speed - stood_s
        if age_s <= self._watch.stale_angle_s:
            return None
        if not np.isfinite(age_s):
            return _worded(self._receiver)
        return f"angle sensor: the angle is stale, the newest one is {age_s * 1e3:.0f} ms old"

    def _note(self, reason: str) -> None:
        """The first trouble of a sensor that this test does not need stands in its recording."""
        if not self._noted and self._journal is not None:
            self._noted = True
            event = {"event": "angle_trouble", "reason": reason, "time_s": self._clock.now_s()}
            with contextlib.suppress(JournalError):  # whoever writes a pulse or a sample next reports it
                self._journal.append_json(Kind.EVENT, event)

    def _wrong(self, samples: NDArray[Any]) -> str | None:
        """Return the fault of this block in words, or None."""
        angle_rad, now_s = samples["angle_rad"], float(samples["host_time_s"][-1])
        fault = (
            _unreliable(samples)
            or self._jumped(samples)
            or self._outside(angle_rad)
            or self._away(angle_rad)
            or self._frozen(angle_rad, now_s)
            or self._rate.fault(len(samples), int(samples["counter"][-1]), now_s)
        )
        self._last = float(angle_rad[-1]), int(samples["counter"][-1]), now_s
        return fault

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

    def _frozen(self, angle_rad: NDArray[np.float64], now_s: float) -> str | None:
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


def _worded(receiver: AngleReceiver) -> str:
    problem = receiver.problem or "angle sensor: no angle arrives; check its cable and supply"
    return problem if problem.startswith("angle sensor") else f"angle sensor: {problem}"


def outside(angle_rad: float, bound: Limit) -> str:
    """An angle outside a range, in words; one that is beyond it by a hair is not told as the end itself."""
    beyond_rad = max(bound.lo - angle_rad, angle_rad - bound.hi)
    digits = 1 if beyond_rad >= math.radians(0.1) else 3
    return f"{degrees(angle_rad, digits)} is outside {degrees(bound.lo)} … {degrees(bound.hi)} ({bound.owner})"


def degrees(angle_rad: float, digits: int = 1) -> str:
    return f"{math.degrees(angle_rad):.{digits}f}°"


async def await_angle(receiver: AngleReceiver, tasks: Tasks) -> None:
    """Wait a moment for the first angle: right after connecting there is none."""
    clock = tasks.clock
    end_s = clock.now_s() + PATIENCE_S * clock.speed
    while receiver.angle_around(AROUND_S * clock.speed) is None and clock.now_s() <= end_s:
        await tasks.sleep(0.02)


def check_start(receiver: AngleReceiver, plan: TestPlan, table: dict[str, Limit], clock: Clock) -> None:
    """Check where the joint is before a test that asks for its angle.

    Raises DeviceError: no angle arrives. RefusedError: it is outside the range, or away from the target; says by how
    much.
    """
    if plan.angle is None:
        return
    now_rad = receiver.angle_around(AROUND_S * clock.speed)
    if now_rad is None:
        raise DeviceError(_worded(receiver))
    bound, target_rad, tolerance_rad = table["angle_rad"], plan.angle.target_rad, plan.angle.tolerance_rad
    if check(bound, now_rad) is not None:
        raise RefusedError(f"plan.angle: {outside(now_rad, bound)}; move the joint into it")
    if target_rad is not None and not (abs(now_rad - target_rad) <= tolerance_rad):
        raise RefusedError(
            f"plan.angle: the joint is at {degrees(now_rad)}, this test needs {degrees(target_rad)} ± "
            f"{degrees(tolerance_rad)}; move it there"
        )
