"""The recruitment curve's knots and smoothness chosen again, once a model knows what the joint's movement does."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from stimrig.identify.effects import get
from stimrig.identify.estimation.gram import gram
from stimrig.identify.estimation.joint import Fitted, solve
from stimrig.identify.estimation.rows import still_rows
from stimrig.identify.noise.level import whitened
from stimrig.identify.recruitment.knots import QUIET_KNOTS, adapted_knots, bending_order, spline_roughness
from stimrig.identify.recruitment.smoothing import choose_weight
from stimrig.identify.recruitment.spline import SplineBasis
from stimrig.identify.simulation.problem import Problem

TIMES = 2
"""The first curve shows roughly where the knots belong, the second one better."""
CURVE_POINTS = 1001


def renewed_curve(base: Fitted) -> Fitted:
    """The model with the knots and the smoothness of its curve chosen with all rows, where the evidence rises by that.

    The plain structure is fitted where the joint is held still (`still_rows`), since elsewhere it lacks g and h; its
    curve is as smooth as those rows alone ask for. Once g and h are there, the other rows tell of f, too.

    Parameters
    ----------
    base : Fitted
        A model with its effects. It is returned as it is if its curve was chosen with all rows already (also where
        the joint was nowhere still for long enough), if no effect of it depends on the joint, or if its curve is no
        smoothed spline.
    """
    if not _can_be_renewed(base):
        return base
    with suppress(np.linalg.LinAlgError):  # then the curve as it is remains the best one known
        for _ in range(TIMES):
            found = _renewed(base)
            if not found.log_evidence > base.log_evidence or (base.converged and not found.converged):
                break
            base = found
    return base


def knows_joint(fitted: Fitted) -> bool:
    """Whether an effect of the model depends on the joint."""
    return any(get(name).moves_with_joint for name, _ in fitted.effects)


def _can_be_renewed(base: Fitted) -> bool:
    setup = base.problem.setup
    smoothed = isinstance(setup.basis, SplineBasis) and np.any(setup.roughness) and not np.any(setup.curve_nm)
    return bool(smoothed and knows_joint(base) and not np.all(still_rows(setup.grid, setup.fitted)[setup.fitted]))


def _renewed(base: Fitted) -> Fitted:
    """The model with more knots, where its present curve bends, and with the smoothness that all rows ask for."""
    setup, values = base.problem.setup, base.physical
    old, place = setup.basis, base.problem.coefficients
    assert isinstance(old, SplineBasis)
    curve_nm = values[place]
    u = np.linspace(0.0, old.largest_us, CURVE_POINTS)
    torque_nm = old.design(u) @ curve_nm
    basis = SplineBasis(adapted_knots((u[::5], torque_nm[::5]), old.largest_us, QUIET_KNOTS))
    order = bending_order(setup.grid.pulse_width_us[setup.fitted])
    roughness = spline_roughness(basis, (old, curve_nm), order)
    start_nm = np.linalg.lstsq(basis.design(u), torque_nm, rcond=None)[0]
    rough = Problem(setup.with_(basis=basis, roughness=roughness), base.effects)
    theta = rough.from_physical(np.concatenate([values[: place.start], start_nm, values[place.stop :]]))
    precision = _precision(rough, theta, base, roughness)
    return solve(Problem(setup.with_(basis=basis, roughness=precision), base.effects), theta, base.noise)


def _precision(problem: Problem, theta: np.ndarray, base: Fitted, roughness: np.ndarray) -> np.ndarray:
    """The prior precision of the curve's coefficients, by REML at a point; all else is linear there, too."""
    setup, place = problem.setup, problem.coefficients
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    curve = np.arange(place.start, place.stop)
    others = np.delete(np.arange(problem.size), curve)
    # what the curve and the others' changes have to explain: the residual, and the curve itself
    left = setup.target_nm - mean + theta[place] @ slopes[place]
    rows = np.vstack([left, slopes[curve], slopes[others]]) / setup.spread
    products = gram(whitened(rows, setup.stretches, base.noise))
    inner = 1 + curve.size
    bound = products[inner:, inner:] + problem.prior[1][np.ix_(others, others)]
    own = products[:inner, :inner] - products[:inner, inner:] @ np.linalg.solve(bound, products[inner:, :inner])
    design, moment = ((own + own.T) / 2)[1:, 1:].copy(), own[1:, 0].copy()
    chosen = choose_weight(design, moment, float(own[0, 0]), int(setup.fitted.sum()), roughness, others.size)
    return chosen.weight / chosen.variance * roughness
