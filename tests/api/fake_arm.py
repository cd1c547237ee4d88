"""The arm of a fake rig: where it is, and what its angle sensor says; none unless a way is given to it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from typing import Any

from stimrig.rig import messages as m

RATE_HZ = 200.0
ZERO_S = 1000.0
"""When a test begins, on the rig's clock."""
Way = Callable[[float], tuple[float, float]]
"""From the time (s) to the angle (rad) and its velocity (rad/s)."""


def still(angle_rad: float) -> Way:
    return lambda _time_s: (angle_rad, 0.0)


def back_and_forth(low: float, high: float, speeds_rad_s: tuple[float, ...] = (0.4, 1.2)) -> Way:
    """From end to end at each speed in turn."""

    def at(time_s: float) -> tuple[float, float]:
        left_s = time_s % sum(2 * (high - low) / speed for speed in speeds_rad_s)
        for speed in speeds_rad_s:
            once_s = (high - low) / speed
            if left_s < once_s:
                return low + speed * left_s, speed
            if left_s < 2 * once_s:
                return high - speed * (left_s - once_s), -speed
            left_s -= 2 * once_s
        return low, 0.0

    return at


class FakeArm:
    """Not there until `way` is set."""

    def __init__(self) -> None:
        self.way: Way | None = None
        self.problem = ""
        self.first: m.AnglePose | None = None
        self.calibration: m.AngleCalibration | None = None

    def status(self, time_s: float) -> m.AngleStatus:
        if self.way is None:
            return m.AngleStatus()
        angle_rad, velocity_rad_s = self.way(time_s)
        return m.AngleStatus(
            present=True, angle_rad=angle_rad, velocity_rad_s=velocity_rad_s, age_s=0.003,
            calibrated=self.calibration is not None, range_rad=(-0.1, 2.4), problem=self.problem, pose=self.first,
            calibration=self.calibration,
        )  # fmt: skip

    def now(self, time_s: float) -> dict[str, Any]:
        if self.way is None:
            return {}
        angle_rad, velocity_rad_s = self.way(time_s)
        return {"angle_rad": angle_rad, "velocity_rad_s": velocity_rad_s}

    def live(self, start: float, end: float) -> dict[str, Any]:
        """Of a frame: the newest, and every sample."""
        if self.way is None:
            return {}
        times = [k / RATE_HZ for k in range(round(start * RATE_HZ), round(end * RATE_HZ))]
        rows = [m.ANGLE_ROW.pack(ZERO_S + time_s, *self.way(time_s)) for time_s in times]
        return {**self.now(end), "angle": b64encode(b"".join(rows)).decode()}

    def refuses(self, plan: m.TestPlan, time_s: float) -> str:
        """Why a start is refused; empty: it is not."""
        if plan.angle is None:
            return ""
        if self.way is None:
            return "this rig has no angle sensor"
        angle_rad, target = self.way(time_s)[0], plan.angle.target_rad
        if target is not None and abs(angle_rad - target) > plan.angle.tolerance_rad:
            return f"the joint is at {angle_rad:.2f} rad, not within {plan.angle.tolerance_rad:g} rad of {target:.2f}"
        return ""

    def pose(self, angle_rad: float, by: str, time_s: float, first: bool = False) -> str:
        """Take a pose; why it is refused, or nothing."""
        if self.way is None:
            return "this rig has no angle sensor"
        found = m.AnglePose(angle_rad=angle_rad, raw=57.3 * self.way(time_s)[0] + 12.0)
        if self.first is None or first:
            self.first = found
            return ""
        if abs(angle_rad - self.first.angle_rad) < 0.5:
            return "the poses are less than 0.5 rad apart"
        self.calibration = m.AngleCalibration(
            poses=[self.first, found], offset=12.0, direction=1, radians_per_unit=0.01745, by=by,
            set_at_utc="2026-11-23T08:30:00.000Z",
        )  # fmt: skip
        self.first = None
        return ""
