"""A muscle in an arm: what the load cell between the forearm and whatever holds it measures.

Of the forearm: I ẍ = active + passive + gravity − cell. So the cell measures

    T = active(f, G, x, ẋ) + passive(x, ẋ) + gravity(x) − I ẍ,    flexion positive,

where I is that of forearm, hand and all that moves with them on the muscle's side of the cell. What the holder's side
of the cell weighs does not appear. A forearm that nobody holds loads no cell: T = 0 and I ẍ = active + passive +
gravity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hardware_sim.arm import registry
from hardware_sim.arm.description import Arm
from hardware_sim.arm.motion import Begin, Motion
from hardware_sim.patients.muscle import Muscle

LONGEST_STEP_S = 1.0 / 1600.0
INERTIA_KG_M2 = 0.07


class Limb:
    """A muscle whose joint moves; it implements the `Muscle` protocol for load cell and electrodes."""

    def __init__(self, muscle: Muscle, arm: Arm, seed: int = 0) -> None:
        self._seed = seed
        self.motion = Motion(math.radians(arm.start_deg))
        self.converted_nm = getattr(muscle, "converted_nm", None)
        self._muscle = muscle
        self._time_s = 0.0
        self._isometric_nm = 0.0
        self.move(arm.mode, arm.movement)

    def move(self, mode: str, settings: Mapping[str, Any], time_s: float = 0.0) -> None:
        """Hold or move the forearm otherwise from now on.

        Raises
        ------
        ArmError
            There is no such mode, or a setting makes no sense; then it goes on as before.
        """
        self._advance(time_s)
        self._mover = registry.make(mode, Begin(self._time_s, self.motion, self._seed), settings)
        self.mode = mode

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        self._advance(time_s)
        self._muscle.pulse(time_s, width_us, current_ma)

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the torque on the load cell, N·m, without the sensor's noise."""
        self._advance(time_s)
        if not self._mover.holds:
            return 0.0
        return self._net_nm(*self.motion[:2]) - INERTIA_KG_M2 * self.motion.acceleration_rad_s2

    def angle_deg(self, time_s: float) -> float:
        """Advance to `time_s` and give the true angle there, degrees."""
        self._advance(time_s)
        return math.degrees(self.motion.angle_rad)

    def state(self) -> dict[str, Any]:
        """True angle and velocity, and what moves it."""
        return {
            "arm": self.mode,
            "angle_deg": math.degrees(self.motion.angle_rad),
            "velocity_deg_s": math.degrees(self.motion.velocity_rad_s),
        }

    def _advance(self, time_s: float) -> None:
        span_s = time_s - self._time_s
        if span_s <= 0.0:
            return
        steps = max(1, math.ceil(span_s / LONGEST_STEP_S - 1e-9))
        begin_s = self._time_s
        for step in range(1, steps + 1):
            self._step_to(begin_s + step * span_s / steps)

    def _step_to(self, time_s: float) -> None:
        self.motion = self._mover.advance(time_s, self._acceleration_rad_s2)
        self._isometric_nm = self._muscle.torque_nm(time_s)
        self._time_s = time_s

    def _acceleration_rad_s2(self, angle_rad: float, velocity_rad_s: float) -> float:
        return self._net_nm(angle_rad, velocity_rad_s) / INERTIA_KG_M2

    def _net_nm(self, angle_rad: float, velocity_rad_s: float) -> float:  # noqa: ARG002
        return self._isometric_nm
