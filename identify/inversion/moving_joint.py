"""The joint in a trial: what it gives by itself, and how much of the muscle's torque is left there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.model import Model
from identify.simulation.joint_surface import Surfaces
from identify.simulation.pulses import Motion, above_rest

LEAST_GAIN = 0.05
"""Where less than this share of the torque is left, stimulation is not the way to have more of it."""


@dataclass(frozen=True)
class Joint:
    """g and h along a movement.

    Parameters
    ----------
    gain : ndarray, shape (K,), or float
        g at each pulse, at least `LEAST_GAIN`.
    passive_nm : ndarray, shape (K,), or float
        Torque without any pulse, above rest, positive in the direction of pull, N·m.
    """

    gain: np.ndarray | float = 1.0
    passive_nm: np.ndarray | float = 0.0

    @classmethod
    def of(cls, model: Model, motion: Motion | None, sign: float, pulse_rate_hz: float) -> Joint:
        """Along a movement; that of a joint held still without one.

        Raises
        ------
        BadModel
            As `above_rest`.
        """
        surfaces = Surfaces.of(model)
        if surfaces is None:
            return cls()
        size = 1 if motion is None else motion.angle_rad.size
        passive_nm = sign * above_rest(model, np.zeros(size), pulse_rate_hz, motion)
        assert motion is not None  # `above_rest` has refused
        return cls(np.maximum(surfaces.g(motion.angle_rad, motion.velocity_rad_s), LEAST_GAIN), passive_nm)

    def active(self, wanted_nm: np.ndarray) -> np.ndarray:
        """What the muscle has to give at the model's own angle, for a whole torque, N·m, shape (K,)."""
        return (wanted_nm - self.passive_nm) / self.gain
