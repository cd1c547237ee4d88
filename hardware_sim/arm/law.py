"""What the laws of the arm's tissue have in common; each works on numbers and on arrays."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Number = Any
"""A float or an array of floats; arrays of one call have shapes that broadcast."""
Floats = NDArray[np.float64]


class PassiveLaw:
    """Base of passive laws. Most have no memory: their torque follows from angle and velocity."""

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque after the joint has been there for long, N·m."""
        raise NotImplementedError

    def begin(self, angle_rad: float) -> float:  # noqa: ARG002
        """The memory of a joint that has been at this angle for long."""
        return 0.0

    def step(self, memory: float, angle_rad: float, step_s: float) -> float:  # noqa: ARG002
        """The memory one step later."""
        return memory

    def remembered_nm(self, memory: Number, angle_rad: Number) -> Number:  # noqa: ARG002
        """What the memory adds to `torque_nm`, N·m."""
        return 0.0


class AngleLaw(Protocol):
    """Share of active torque at an angle."""

    def share(self, angle_rad: Number) -> Number:
        """Never below 0."""
        ...


class VelocityLaw(Protocol):
    """Share of active torque at a velocity, which may depend on the angle."""

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """1 at rest, never below 0."""
        ...
