"""What the forearm weighs, and where the elbow's range ends.

Winter 2009, table 4.1: forearm and hand have 0.022 of the body's mass, the centre of mass at 0.682 and a radius of
gyration about the elbow of 0.827 of the length from elbow to wrist. For 75 kg and 0.254 m: 1.65 kg, an inertia of
0.073 kg·m², and 2.8 N·m when it is horizontal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stimrig.hardware_sim.arm.law import Number


@dataclass(frozen=True)
class Mechanics:
    """The forearm as a rigid body in a plane.

    Gravity pulls with -weight_nm · sin(angle + upper_arm_deg): the upper arm hangs down at 0 degrees, where the
    straight arm needs no torque, and points forward at 90. `weight_nm` 0 (as it is unless given) is a forearm in a
    horizontal plane. Beyond `least_deg` and `most_deg` a stop pushes back, stiffer while it is being compressed, and
    never pulls (Hunt and Crossley 1975).
    """

    ABOVE: ClassVar[dict[str, float]] = {"inertia_kg_m2": 0.0, "stop_nm_per_rad": 0.0}

    inertia_kg_m2: float = 0.07
    weight_nm: float = 0.0
    upper_arm_deg: float = 0.0
    least_deg: float = -5.0
    most_deg: float = 145.0
    stop_nm_per_rad: float = 200.0
    stop_loss_s_per_rad: float = 0.5

    def gravity_nm(self, angle_rad: Number) -> Number:
        """Gravity's torque on the elbow, flexion positive."""
        return -self.weight_nm * np.sin(angle_rad + math.radians(self.upper_arm_deg))

    def stops_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """What the stops push with, flexion positive."""
        over = np.maximum(angle_rad - math.radians(self.most_deg), 0.0)
        under = np.maximum(math.radians(self.least_deg) - angle_rad, 0.0)
        flexed = over * np.maximum(1.0 + self.stop_loss_s_per_rad * velocity_rad_s, 0.0)
        extended = under * np.maximum(1.0 - self.stop_loss_s_per_rad * velocity_rad_s, 0.0)
        return self.stop_nm_per_rad * (extended - flexed)
