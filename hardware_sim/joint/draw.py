"""A joint of two muscles, drawn by a seed.

How it is drawn (U: uniform, L: log-uniform, N: normal; all independent):

- *Each muscle* is one of `hardware_sim.hidden.base`: eight shapes of recruitment, 3 to 15 N·m at its largest pulse of
  250 to 400 µs and 20 mA, 10 to 90 % within 26 to 150 µs; dynamics of second order, damping from 0.6, with a time
  constant of 0.1 to 0.5 s (drawn again outside). Its 1000 units are equal parts of the torque, their thresholds such
  that the own electrode gives that curve.
- *Cross-talk* (half of the seeds): each direction U(0.03, 0.3), and with probability 0.4 one of the two none. An
  electrode reaches a share of the other muscle's units, any of them, U(1.3, 3) times the cross-talk and at most 0.9. A
  unit's threshold there is its own one to the power U(0.3, 1), times exp N(0, 0.35), times what makes the electrode's
  largest pulse fire as many units as the cross-talk says.
- *Co-contraction* (half): U(0.04, 0.25) of the torque lost at full activity of both; the agonist's share of the
  stiffness U(0.35, 0.65).
- *Fatigue* (a quarter of the muscles): full activity takes away U(0.1, 0.3) of the torque, within L(20, 60) s.
- *Speed that depends on activation* (a tenth of the muscles): up to U(-0.3, 0.5) faster at full torque.

ASSUMED, for want of records with known truth: the numbers of the last four, within what is reported of surface
electrodes at elbow and knee. Seeds 0 to 99 are for development; reported figures use seeds from 1000.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.hidden.base import Base, draw_base
from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.hidden.scenario import rng_of
from stimrig.hardware_sim.joint.muscles import Joint, JointMuscle

UNITS = 1000
LARGEST_CROSS_TALK, LARGEST_CO_CONTRACTION = 0.5, 0.5
"""Of those that may be asked for."""


def draw_joint(
    seed: int, cross_talk: float | None = None, co_contraction: float | None = None, plain: bool = False
) -> Joint:
    """The joint that `seed` draws.

    Parameters
    ----------
    cross_talk, co_contraction : float, optional
        Instead of what is drawn; the cross-talk in both directions. All else stays as the seed has it.
    plain : bool
        Neither fatigue nor speed that depends on activation.

    Raises
    ------
    ValueError
        A number out of 0 to 0.5.
    """
    for asked, largest in ((cross_talk, LARGEST_CROSS_TALK), (co_contraction, LARGEST_CO_CONTRACTION)):
        if asked is not None and not 0.0 <= asked <= largest:
            raise ValueError(f"cross-talk and co-contraction of {asked:g}: give 0 to {largest:g}")
    shares = _draw_cross_talk(rng_of(seed, "joint, cross-talk"))
    if cross_talk is not None:
        shares = cross_talk, cross_talk
    bases = [_draw_base(rng_of(seed, "joint, muscle", name)) for name in ("agonist", "antagonist")]
    muscles = [
        _draw_muscle(rng_of(seed, "joint, units", str(m)), bases[m], bases[1 - m], shares[1 - m], plain) for m in (0, 1)
    ]
    rng = rng_of(seed, "joint, co-contraction")
    strength, part = float(rng.uniform(0.04, 0.25)) * (rng.random() < 0.5), float(rng.uniform(0.35, 0.65))
    strength = strength if co_contraction is None else co_contraction
    stiffness = strength / (1.0 - strength)
    return Joint(seed, muscles[0], muscles[1], (part * stiffness, (1.0 - part) * stiffness))


def _draw_cross_talk(rng: Generator) -> tuple[float, float]:
    """Of the agonist's electrode, and of the antagonist's."""
    shares = rng.uniform(0.03, 0.3, 2)
    if rng.random() < 0.4:
        shares[int(rng.integers(2))] = 0.0
    first, second = (shares * (rng.random() < 0.5)).tolist()
    return first, second


def _draw_base(rng: Generator) -> Base:
    while True:
        base = draw_base(rng)
        if 0.1 <= base.t_omega_s <= 0.5:
            return base


def _draw_muscle(rng: Generator, base: Base, other: Base, share: float, plain: bool) -> JointMuscle:
    """A muscle whose units' share that the electrode of `other` fires is this."""
    curve_nm = np.maximum.accumulate(base.table_nm)
    unit_nm = float(curve_nm[-1]) / UNITS
    own_us = np.interp(unit_nm * (np.arange(UNITS) + 0.5), curve_nm, np.arange(curve_nm.size))
    fired = np.count_nonzero(own_us <= base.largest_width_us)
    other_us = _thresholds_us(rng, own_us, round(share * fired), float(other.largest_width_us))
    depth, lasting_s = float(rng.uniform(0.1, 0.3)), math.exp(rng.uniform(math.log(20.0), math.log(60.0)))
    tires = rng.random() < 0.25 and not plain
    faster = float(rng.uniform(-0.3, 0.5)) * (rng.random() < 0.1 and not plain)
    return JointMuscle(base, own_us, other_us, unit_nm, depth * tires, lasting_s, faster)


def _thresholds_us(rng: Generator, own_us: Floats, count: int, largest_us: float) -> Floats:
    """At which width of the other electrode units fire, so that `count` do at its largest pulse."""
    wide, power, order = float(rng.uniform(1.3, 3.0)), float(rng.uniform(0.3, 1.0)), rng.permutation(UNITS)
    scatter = np.exp(rng.normal(0.0, 0.35, UNITS))
    thresholds_us = np.full(UNITS, np.inf)
    if count:
        reached = order[: max(count, min(round(wide * count), round(0.9 * UNITS)))]
        eager = own_us[reached] ** power * scatter[reached]
        last = np.partition(eager, count - 1)[count - 1]
        thresholds_us[reached] = eager / last * largest_us
    return thresholds_us
