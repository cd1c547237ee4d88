"""No tissue at all: the torque at the joint is the muscle's alone."""

from __future__ import annotations

from dataclasses import dataclass

from stimrig.hardware_sim.arm.law import Number, PassiveLaw


@dataclass(frozen=True)
class Law(PassiveLaw):
    """Zero everywhere."""

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Zero, in the shape of both."""
        return 0.0 * angle_rad + 0.0 * velocity_rad_s
