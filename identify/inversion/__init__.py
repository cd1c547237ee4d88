"""From a torque that a controller wants to the pulse widths that follow it best; where it cannot be had, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.inversion.demand import Bounds, best_demand
from stimrig.identify.inversion.plant import Plant
from stimrig.identify.inversion.reached import Inversion, judged
from stimrig.identify.inversion.reference import Reference
from stimrig.identify.model import Model
from stimrig.identify.simulation.joint_surface import Surfaces
from stimrig.identify.simulation.pulses import Motion, above_rest

__all__ = ["Inversion", "Reference", "invert"]

TURNS = 10
"""Corrections on the model's own prediction, at most: each is a trial that the model plays."""
STEP = 0.8
"""Share of the predicted error that a correction asks for."""
ENOUGH = 2e-3
"""Root mean square of the predicted error, as a share of the largest torque, below which no correction follows."""
GAIN = 0.97
"""A correction that leaves more than this share of the best error so far is the last one but one."""


def invert(
    model: Model,
    reference: Reference,
    *,
    largest_us: float | None = None,
    rise_us: float | None = None,
    whole: bool = True,
) -> Inversion:
    """The pulse widths whose predicted torque follows a reference best.

    The demand before f is found by regularised least squares through G (norm-optimal control, Amann, Owens and Rogers
    1996), with 0 and the largest demand as bounds; f is inverted; then the demand is corrected on what the model
    predicts, effects included, as between trials. Where the joint moves, the passive torque h is taken off what is
    wanted, and the rest divided by g (Fig. 2 of the paper, read backwards).

    Parameters
    ----------
    model : Model
        With second-order dynamics; with or without effects.
    reference : Reference
        Torque above rest.
    largest_us : float, optional
        Widest pulse, µs; never wider than the model is valid for.
    rise_us : float, optional
        Largest rise from pulse to pulse, µs. The rig's gate has such a limit.
    whole : bool
        Whole µs. What rounding takes is given back by the pulses after.

    Raises
    ------
    BadModel
        The model has other dynamics, gives no torque, or holds for another pulse rate; it depends on the joint, and
        the reference has no angle.
    BadRequest
        A limit is not a positive number.
    """
    plant = Plant.of(model, reference, largest_us, rise_us, whole)
    rate_hz, motion = reference.pulse_rate_hz, reference.motion
    joint = _Joint.of(model, motion, plant.sign, rate_hz)
    wanted = plant.sign * reference.torque_nm
    needed = joint.active(wanted)
    demand, best, least = np.zeros(wanted.size), None, np.inf
    target, idle = needed, 0
    for _ in range(TURNS):
        demand = best_demand(plant.a, plant.b, target, Bounds(plant.largest_nm, plant.rises(demand)))
        widths = plant.widths(demand)
        got = plant.sign * above_rest(model, widths, rate_hz, motion)
        error = wanted - got
        left = float(np.sqrt(np.mean(error**2)))
        idle = idle + 1 if left > GAIN * least else 0
        if left < least:
            best, least = (demand, widths, got), left
        if idle > 1 or left < ENOUGH * plant.largest_nm or (not model.effects and rise_us is None):
            break
        target = plant.linear(demand) + STEP * error / joint.gain
    assert best is not None
    return judged(plant, reference, needed, *best)


LEAST_GAIN = 0.05
"""Where less than this share of the torque is left, stimulation is not the way to have more of it."""


@dataclass(frozen=True)
class _Joint:
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
    def of(cls, model: Model, motion: Motion | None, sign: float, pulse_rate_hz: float) -> _Joint:
        """Along a movement; that of a joint held still without one.

        Raises
        ------
        BadModel
            As `above_rest`.
        """
        surfaces = Surfaces.of(model.effects)
        if surfaces is None:
            return cls()
        size = 1 if motion is None else motion.angle_rad.size
        passive_nm = sign * above_rest(model, np.zeros(size), pulse_rate_hz, motion)
        assert motion is not None  # `above_rest` has refused
        return cls(np.maximum(surfaces.g(motion.angle_rad, motion.velocity_rad_s), LEAST_GAIN), passive_nm)

    def active(self, wanted_nm: np.ndarray) -> np.ndarray:
        """What the muscle has to give at the model's own angle, for a whole torque, N·m, shape (K,)."""
        return (wanted_nm - self.passive_nm) / self.gain
