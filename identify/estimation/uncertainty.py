"""95 % bands on the recruitment curve, the step response and the prediction, from the parameters' covariance.

There are two kinds. The pointwise band contains the true value at any one place in 95 % of records. The whole band
contains the whole true curve in 95 % of records; its width is found by drawing curves from the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, make_grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.fit_statistics import held_out_change
from stimrig.identify.estimation.rests import RELAXED_S, scatter_at_rest, since_pulse, wandering_zero_nm
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.model import Covariance, Model
from stimrig.identify.problem.joint_surface import POINTWISE
from stimrig.identify.problem.predict import same_data, slopes, unpredictable_torque
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SplineBasis

BLOCK_S = 3.0
"""Longer than a contraction's rise: within a block, what is wrong stays wrong."""
NEGLIGIBLE = 1e-4
"""Directions in which a change varies by less than this share of the largest are ignored."""
EASED = 0.995
"""Share of the penalty that is removed to see how far it holds the curve back."""
BETWEEN = 0.25
"""Mean square by which another protocol departs from the whole fit, over that by which two parts differ: each part
departs by about half of their difference."""
MOST_BETWEEN = 2.0
"""Largest part of it, over the other variance: far from linear one step may go anywhere."""
ZERO = 1.25
"""Mean square by which another record's zero departs from the mean of the rests, over their mean square about it. With
1.0 bands held 86 % of the torque where the zero wanders, with 1.5 96 %, but 99 % where force lingers at rest."""
PLACES = 481
"""Widths at which a change of the curve is looked at: several between any two knots."""
BETWEEN_KNOTS = 1.25
"""Error of the curve between knots, as a share of its second difference over half of their distance: so large that the
tests of `compare` alarm on 5 % of exact muscles."""
DRAWS = 256
POINTS = 41
DYNAMICS = ("time_constant_s", "damping", "delay_s")


def covariance_of(fitted: Fitted) -> np.ndarray:
    """Covariance of the parameters, in their units, shape (P, P), that holds too where the structure is wrong.

    The penalty of the curve is a prior, so this begins with the covariance of the posterior: averaged over the curve,
    bands from it contain the truth as often as stated (Nychka 1988). If the model is right, the gradients of the log
    likelihood by blocks vary as much as the information says. What the model has wrong lasts longer than a sample and
    makes them vary more (White 1982; Liang and Zeger 1986, clusters); then that counts, in each direction. And where
    the penalty holds the curve back, the truth may be as far off as the curve would go without it.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    values, vectors = np.linalg.eigh(fitted.hessian * scale[:, None] * scale[None, :])
    determined = values > 1e-14 * values.max()
    root = scale[:, None] * vectors[:, determined] / np.sqrt(values[determined])
    gradients, information = _block_gradients(fitted)
    values, vectors = np.linalg.eigh(_beyond(root.T @ gradients, root.T @ information @ root))
    wider, held_back = root @ vectors * np.sqrt(np.maximum(values, 0.0)), _held_back(fitted)
    slope = np.where(fitted.problem.log, fitted.physical, 1.0)
    return (root @ root.T + wider @ wider.T + np.outer(held_back, held_back)) * slope[:, None] * slope[None, :]


def _beyond(gradients: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Excess covariance of the gradients of blocks, shape (P, B), over the information, shape (P, P).

    A few blocks say little of many directions. So their covariance is drawn towards a multiple of the information, as
    far as it varies itself from block to block (Ledoit and Wolf 2004).
    """
    blocks = gradients.shape[1]
    few = blocks / max(blocks - 1, 1)
    block_covariance = few * gradients @ gradients.T
    usual = information * float(np.trace(block_covariance) / max(np.trace(information), 1e-300))
    scatter = few**2 * float(np.sum(np.sum(gradients**2, axis=0) ** 2)) - float(np.sum(block_covariance**2)) / blocks
    share = np.clip(scatter / max(float(np.sum((block_covariance - usual) ** 2)), 1e-300), 0.0, 1.0)
    return share * usual + (1.0 - share) * block_covariance - information


def _block_gradients(fitted: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the log likelihood by blocks, shape (P, B), and the information, shape (P, P)."""
    setup = fitted.problem.setup
    white = setup.whitened(np.vstack([fitted.residual_nm, fitted.slopes]), fitted.noise)
    at = np.concatenate([np.arange(start, stop) for start, stop in zip(*setup.stretches, strict=True)])
    block = (at * setup.grid.step_s / BLOCK_S).astype(np.int64) + 10**6 * setup.grid.part[at]
    borders = np.flatnonzero(np.r_[True, block[1:] != block[:-1]])
    return np.add.reduceat(white[1:] * white[0], borders, axis=1), white[1:] @ white[1:].T


def _held_back(fitted: Fitted) -> np.ndarray:
    """Largest change of the curve's coefficients when most of the penalty is removed, shape (P,).

    To first order, and as far as it is more than the noise gives a curve that is as smooth as the penalty says. Below
    the smallest width played no further than a rising curve can be from zero.
    """
    mean, precision = fitted.problem.prior
    at, largest_change = fitted.problem.coefficients, np.zeros(fitted.theta.size)
    prior = np.zeros_like(precision)
    prior[at, at] = precision[at, at]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    both = scale[:, None] * scale[None, :]
    whole, prior = fitted.hessian * both + 1e-9 * np.eye(scale.size), prior * both
    eased = np.linalg.inv(whole - EASED * prior)
    change = (eased @ (EASED * prior @ ((fitted.theta - mean) / scale)))[at]
    usual = eased @ (whole - (1.0 - (1.0 - EASED) ** 2) * prior) @ eased - np.linalg.inv(whole)
    values, vectors = np.linalg.eigh(usual[at, at])
    determined = values > NEGLIGIBLE * max(float(values.max()), 1e-300)
    ratio = float(np.mean((vectors.T @ change)[determined] ** 2 / values[determined])) if determined.any() else 0.0
    change *= scale[at] * np.sqrt(max(1.0 - 1.0 / max(ratio, 1.0), 0.0))
    largest_change[at] = _below_played(fitted, change) if change.any() else change
    return largest_change


def _below_played(fitted: Fitted, change: np.ndarray) -> np.ndarray:
    """A change of the coefficients, with that of widths below the smallest one played no larger than the torque there.

    There the data say next to nothing, and without its penalty a spline may go anywhere.
    """
    setup = fitted.problem.setup
    played = setup.grid.pulse_width_us[setup.fitted & (setup.grid.pulse_width_us > 0.0)]
    first, basis = float(played.min(initial=setup.basis.largest_us)), setup.basis
    limit = np.abs(basis.design(np.array([first])) @ np.c_[fitted.theta[fitted.problem.coefficients], change]).sum()
    at_us = np.linspace(0.0, basis.largest_us, PLACES)
    design = basis.design(at_us)
    value = design @ change
    limited = np.where(at_us < first, np.clip(value, -limit, limit), value)
    return change if np.array_equal(limited, value) else np.linalg.lstsq(design, limited, rcond=None)[0]


def unexplained(fitted: Fitted, matrix: np.ndarray, contradiction: Mapping[str, Any] | None) -> float:
    """Error of a prediction beyond noise and the parameters' uncertainty, N·m, rms, from three sources.

    The error on left-out blocks, from which a part that chance alone may leave is taken off, so that it is zero where
    the structure is right. No error counts for more than the torque's own range: far from linear, one step of a refit
    may go anywhere. Then what parts of the record contradict each other by beyond noise: another protocol may differ
    from all of them as they do. At least the scatter of a zero that wanders, as another record begins at another one.

    `matrix` is the parameters' covariance; `contradiction` as the function of that name gives it.
    """
    rows = fitted.problem.setup.fitted
    range_nm = float(np.ptp(fitted.problem.setup.grid.torque_nm[rows]))
    error = np.clip((fitted.residual_nm - held_out_change(fitted))[rows], -range_nm, range_nm)
    lever = (fitted.slopes / np.where(fitted.problem.log, fitted.physical, 1.0)[:, None])[:, rows]
    noise, noise_error = _noise_of_intervals(fitted)
    uncertain = float(np.sum(matrix * (lever @ lever.T))) / error.size
    more = float(np.mean(error**2)) - noise - uncertain
    remaining = max(more - (2.0 * noise_error) ** 2 / more, 0.0) if more > 0.0 else 0.0
    pairs = contradiction["pairs"] if contradiction else []
    beyond = [
        pair["difference_nm"] ** 2 * (1.0 - pair["limit"] / pair["statistic"])
        for pair in pairs
        if pair["statistic"] > pair["limit"]
    ]
    between = BETWEEN * sum(beyond) / max(len(pairs), 1)
    wander_nm = wandering_zero_nm(fitted.problem.setup.grid, rows, fitted.residual_nm)
    zero = 0.0 if fitted.noise.is_white else ZERO * wander_nm**2  # white noise moves the means of the rests, too
    return float(np.sqrt(max(remaining + min(between, MOST_BETWEEN * (remaining + uncertain)), zero)))


def _noise_of_intervals(fitted: Fitted) -> tuple[float, float]:
    """Variance of the noise of an interval's mean, (N·m)², and its standard error.

    Where noise was taken for slow, what the structure leaves is in it; then it is that about a straight line in each
    rest. Without rests the two cannot be separated, and only the noise of the samples counts.
    """
    setup, noise = fitted.problem.setup, fitted.noise
    grid, rows = setup.grid, setup.fitted
    correlation = 0.0 if noise.is_white else noise.ar1**2
    single = (1.0 - correlation) / (1.0 + correlation)
    largest, count = noise.sd_nm**2, single * float(rows.sum())
    if noise.is_white:
        return largest, largest * np.sqrt(2.0 / count)
    relaxed = rows & (grid.step_s * since_pulse(grid, 0.0) > RELAXED_S)
    smallest = setup.noise_sd_nm**2 / float(np.median(grid.count[rows]))
    at_rest, free = scatter_at_rest(grid, relaxed, fitted.residual_nm)
    variance = float(np.clip(at_rest, smallest, largest)) if free else smallest
    return variance, variance * float(np.sqrt(2.0 / count + 2.0 / max(single * free, 1.0)))


def bands(model: Model) -> dict[str, Any]:
    """Bands on both curves, as in MODEL.json; empty if the method gives no covariance."""
    covariance, linear = model.covariance, model.linear
    if covariance is None or not isinstance(linear, SecondOrder):
        return {}
    width = np.linspace(0.0, model.recruitment.basis.largest_us, POINTS)
    time_s = np.linspace(0.0, linear.memory_s, POINTS)
    curve_slopes = np.zeros((width.size, len(covariance.names)))
    # f's coefficients stand after the dynamics, before the effects (`effect.parameter`).
    last = len(covariance.names) - sum("." in name for name in covariance.names)
    curve_slopes[:, last - model.recruitment.basis.size : last] = model.recruitment.basis.design(width)
    curve = _band(model.recruitment(width), curve_slopes, covariance)
    step = _band(linear.step_response(time_s), step_slopes(linear, covariance, time_s), covariance)
    return {
        "level_percent": 95,
        "recruitment": {"pulse_width_us": width} | curve,
        "step_response": {"time_s": time_s} | step,
    }


def step_slopes(linear: SecondOrder, covariance: Covariance, time_s: np.ndarray) -> np.ndarray:
    """Derivatives of the step response by all parameters, shape (len(time_s), P)."""
    slopes = np.zeros((time_s.size, len(covariance.names)))
    for name in DYNAMICS:
        if name in covariance.names:
            value = getattr(linear, name)
            step = 1e-5 if name == "delay_s" else 1e-4 * value
            up, down = (replace(linear, **{name: near}).step_response(time_s) for near in (value + step, value - step))
            slopes[:, covariance.names.index(name)] = (up - down) / (2 * step)
    return slopes


def prediction_directions(model: Model, grid: Grid) -> np.ndarray:
    """Errors of a prediction of interval means that the model's uncertainty makes usual, N·m, shape (K, D).

    Each is one standard deviation, independent of the others. Beside those of the covariance there is what no spline
    on the fitted knots can follow: a steep curve bends between two knots, too. Without a covariance there are none.
    """
    covariance, curve = model.covariance, model.recruitment
    if covariance is None or not (isinstance(model.linear, SecondOrder) and isinstance(curve.basis, SplineBasis)):
        return np.zeros((grid.size, 0))
    estimated = slopes(model, grid, covariance.names) @ square_root(covariance.matrix)
    knots_us = curve.basis.knots_us
    finer = SplineBasis(np.sort(np.r_[knots_us, 0.5 * (knots_us[1:] + knots_us[:-1])]))
    at_us = np.interp(np.linspace(0.0, 1.0, 4 * finer.size), np.linspace(0.0, 1.0, knots_us.size), knots_us)
    values_nm = np.linalg.lstsq(finer.design(at_us), curve(at_us), rcond=None)[0]
    bend_nm = np.abs(np.diff(np.r_[0.0, values_nm, values_nm[-1]], 2))
    near_nm = np.max([bend_nm, np.r_[bend_nm[1:], 0.0], np.r_[0.0, bend_nm[:-1]]], axis=0)
    names = [f"recruitment_{place}_nm" for place in range(finer.size)]
    between = slopes(model.with_(recruitment=Curve(finer, values_nm)), grid, names) * (BETWEEN_KNOTS * near_nm)
    return np.c_[estimated, between]


def prediction_band(model: Model, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Pointwise 95 % band on the predicted torque without noise, N·m: lower and upper, each of shape (N,).

    It contains the uncertainty of the model, what its structure leaves (`unexplained`) and, where it was not fitted,
    the size of what cannot be foreseen; not the noise of the measurement.

    Raises ValueError: the model has no covariance (another method).
    """
    covariance, linear = model.covariance, model.linear
    if covariance is None or not isinstance(linear, SecondOrder):
        raise ValueError("this model has no covariance")
    grid = make_grid(record)
    lever = slopes(model, grid, covariance.names)
    variance = np.einsum("ij,jk,ik->i", lever, covariance.matrix, lever, optimize=True)
    middle = grid.start_s + (np.arange(grid.size) + float(np.mean(grid.fraction))) * grid.step_s
    share = np.sqrt(sum(rms**2 for _, rms in unpredictable_torque(model).values()))
    sd = np.hypot(np.sqrt(np.maximum(variance, 0.0)), model.fit.get("unexplained_nm", 0.0))
    was_fitted = ~record.held_out if same_data(model, record) else np.zeros(record.time_s.size, bool)
    half = POINTWISE * np.hypot(np.interp(record.time_s, middle, sd), np.where(was_fitted, 0.0, share))
    predicted = model.predict(record)
    return predicted - half, predicted + half


def _band(value: np.ndarray, slopes: np.ndarray, covariance: Covariance) -> dict[str, np.ndarray]:
    matrix = slopes @ covariance.matrix @ slopes.T
    sd = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    factor = whole_factor(matrix, sd)
    return {
        "value": value,
        "lower": value - POINTWISE * sd,
        "upper": value + POINTWISE * sd,
        "whole_lower": value - factor * sd,
        "whole_upper": value + factor * sd,
    }


def whole_factor(matrix: np.ndarray, sd: np.ndarray) -> float:
    """Number of standard deviations within which 95 % of whole curves drawn from the covariance lie."""
    known = sd > 1e-9 * max(float(sd.max()), 1e-300)
    if not known.any():
        return POINTWISE
    scaled = matrix[np.ix_(known, known)] / sd[known][:, None] / sd[known][None, :]
    return float(np.quantile(np.max(np.abs(_draws(len(scaled)) @ square_root(scaled)), axis=1), 0.95))


def square_root(covariance: np.ndarray) -> np.ndarray:
    """The root that is itself symmetric: there is one, so that draws made with it are the same on every computer.

    Eigenvectors alone are not: their signs, and all of those that belong to no eigenvalue above rounding, are as the
    processor's linear algebra has them.
    """
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


@cache
def _draws(size: int) -> np.ndarray:
    """Normal random numbers, always the same, so that a record always gives the same band."""
    return np.random.default_rng(1).standard_normal((DRAWS, size))
