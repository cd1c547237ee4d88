"""Offline records of two muscles at one joint, whose truth is known, for developing and judging what tells them apart.

Simulated at 1600 Hz, sampled at 400 Hz. Both channels play 40 pulses/s, the second half a period after the first. White
noise. What is drawn from where stands in `hardware_sim/joint/draw.py`. Seeds 0 to 99 are for development.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stimrig.hardware_sim.hidden.design import PULSES_PER_S
from stimrig.hardware_sim.hidden.scenario import rng_of
from stimrig.hardware_sim.joint import Joint, draw_joint
from stimrig.hardware_sim.joint.muscles import NOMINAL_CURRENT_MA, STATES, STEPS_PER_S, run

__all__ = ["draw_joint", "record"]

BLOCK = STEPS_PER_S // PULSES_PER_S // 2
"""Steps between the slots of the two channels."""


def record(
    joint: Joint,
    first_us: ArrayLike,
    second_us: ArrayLike,
    *,
    noise_sd_nm: float = 0.05,
    seed: int = 0,
    rate_hz: int = 400,
    current_ma: float = NOMINAL_CURRENT_MA,
) -> dict[str, Any]:
    """A record of a joint that was at rest.

    Parameters
    ----------
    first_us, second_us : array_like, shape (pulses,)
        Widths of the agonist's and the antagonist's pulses; 0 is no pulse.
    seed : int
        Of the noise, beside the joint's own.
    rate_hz : int
        A divisor of 1600.

    Returns
    -------
    dict
        `time_s`; `first_us`, `second_us`, held between pulses; `torque_nm`; without noise `clean_nm`, and `muscle_nm`,
        shape (n, 2): the torque of each muscle before the joint yields, positive in flexion; `truth`.

    Raises
    ------
    ValueError
        Widths of unequal number, or another rate.
    """
    widths_us = np.asarray(first_us, float), np.asarray(second_us, float)
    if widths_us[0].ndim != 1 or widths_us[0].shape != widths_us[1].shape:
        raise ValueError(f"widths {widths_us[0].shape} and {widths_us[1].shape}: give two rows of one length")
    if rate_hz <= 0 or STEPS_PER_S % rate_hz:
        raise ValueError(f"rate {rate_hz} Hz: give a divisor of {STEPS_PER_S}")
    held_us = np.stack([np.repeat(one, 2) for one in widths_us], axis=1)
    held_us[1:, 1], held_us[:1, 1] = held_us[:-1, 1].copy(), 0.0
    charges_us, where = np.unique(held_us * current_ma / NOMINAL_CURRENT_MA, axis=0, return_inverse=True)
    active_nm = np.repeat(joint.active_nm(charges_us)[where.ravel()], BLOCK, axis=0)
    out = np.zeros((len(active_nm) + 1, 3))  # the value at a step knows the pulses before it
    run(active_nm, joint.parameters, np.zeros((2, STATES)), out[1:])
    every = STEPS_PER_S // rate_hz
    first_nm, second_nm, clean_nm = out[:-1:every].T
    held_us = np.repeat(held_us, BLOCK, axis=0)[::every]
    noise_nm = rng_of(seed, "joint record", str(joint.seed)).normal(0.0, noise_sd_nm, clean_nm.size)
    return {
        "time_s": np.arange(clean_nm.size) / rate_hz,
        "first_us": held_us[:, 0],
        "second_us": held_us[:, 1],
        "torque_nm": clean_nm + noise_nm,
        "clean_nm": clean_nm,
        "muscle_nm": np.stack([first_nm, -second_nm], axis=1),
        "truth": joint.truth,
    }
