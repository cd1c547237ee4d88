"""Active torque is the same at every angle."""

from __future__ import annotations

from dataclasses import dataclass

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Law:
    """One everywhere."""

    def share(self, angle_rad: Number) -> Number:
        """1, in the angle's shape."""
        return 1.0 + 0.0 * angle_rad
