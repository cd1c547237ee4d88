"""Active torque is the same at every velocity."""

from __future__ import annotations

from dataclasses import dataclass

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """One everywhere."""

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """1, in the shape of both."""
        return 1.0 + 0.0 * angle_rad + 0.0 * velocity_rad_s
