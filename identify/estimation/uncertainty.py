"""95 % bands on the recruitment curve, the step response and the prediction, from the parameters' covariance.

There are two kinds. The pointwise band contains the true value at any one place in 95 % of records. The whole band
contains the whole true curve in 95 % of records; its width is found by drawing curves from the covariance.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.model import Covariance, Model
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Basis
from stimrig.identify.simulation.predict import same_data, slopes, unforeseen

POINTWISE = 1.959964
BENT = 2.0
"""Factor on the change without penalty; the whole band then contains 95 % of 120 development curves."""
DRAWS = 256
POINTS = 41
DYNAMICS = ("time_constant_s", "damping", "delay_s")


def bands(model: Model, unpenalised_change_nm: np.ndarray) -> dict[str, Any]:
    """Bands on both curves, as in MODEL.json; empty if the method gives no covariance.

    `unpenalised_change_nm` is the change of the recruitment coefficients if most of the penalty were removed, N·m.
    """
    covariance, linear = model.covariance, model.linear
    if covariance is None or not isinstance(linear, SecondOrder):
        return {}
    width = np.linspace(0.0, model.recruitment.basis.largest_us, POINTS)
    time_s = np.linspace(0.0, linear.memory_s, POINTS)
    curve = _band(model.recruitment(width), recruitment_slopes(model.recruitment.basis, covariance, width), covariance)
    _widen(curve, model.recruitment.basis.design(width) @ unpenalised_change_nm)
    step = _band(linear.step_response(time_s), step_slopes(linear, covariance, time_s), covariance)
    return {
        "level_percent": 95,
        "recruitment": {"pulse_width_us": width} | curve,
        "step_response": {"time_s": time_s} | step,
    }


def recruitment_slopes(basis: Basis, covariance: Covariance, width_us: np.ndarray) -> np.ndarray:
    """Derivatives of f(u) by all parameters, shape (len(width_us), P)."""
    found = np.zeros((width_us.size, len(covariance.names)))
    found[:, _coefficients(basis, covariance)] = basis.design(width_us)
    return found


def _coefficients(basis: Basis, covariance: Covariance) -> slice:
    """Place of f's coefficients: after the dynamics, before the effects (`effect.parameter`)."""
    last = len(covariance.names) - sum("." in name for name in covariance.names)
    return slice(last - basis.size, last)


def step_slopes(linear: SecondOrder, covariance: Covariance, time_s: np.ndarray) -> np.ndarray:
    """Derivatives of the step response by all parameters, shape (len(time_s), P)."""
    slopes = np.zeros((time_s.size, len(covariance.names)))
    for name in DYNAMICS:
        if name in covariance.names:
            up, down, width = _neighbours(linear, name)
            change = up.step_response(time_s) - down.step_response(time_s)
            slopes[:, covariance.names.index(name)] = change / width
    return slopes


def prediction_band(model: Model, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Pointwise 95 % band on the predicted torque without noise, N·m: lower and upper, each of shape (N,).

    It contains the uncertainty of the model and, where it was not fitted, the size of what cannot be foreseen; not the
    noise of the measurement. Raises ValueError: the model has no covariance (another method).
    """
    covariance, linear = model.covariance, model.linear
    if covariance is None or not isinstance(linear, SecondOrder):
        raise ValueError("this model has no covariance")
    grid = make_grid(record)
    sd = _sd(slopes(model, grid, covariance.names), covariance)
    middle = grid.start_s + (np.arange(grid.size) + float(np.mean(grid.fraction))) * grid.step_s
    share = np.sqrt(sum(rms**2 for _, rms in unforeseen(model).values()))
    seen = ~record.held_out if same_data(model, record) else np.zeros(record.time_s.size, bool)
    half = POINTWISE * np.hypot(np.interp(record.time_s, middle, sd), np.where(seen, 0.0, share))
    predicted = model.predict(record)
    return predicted - half, predicted + half


def _neighbours(linear: SecondOrder, name: str) -> tuple[SecondOrder, SecondOrder, float]:
    values = {key: getattr(linear, key) for key in DYNAMICS}
    step = 1e-5 if name == "delay_s" else 1e-4 * values[name]
    up = SecondOrder(**(values | {name: values[name] + step}))
    down = SecondOrder(**(values | {name: values[name] - step}))
    return up, down, 2 * step


def _sd(slopes: np.ndarray, covariance: Covariance) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, covariance.matrix, slopes, optimize=True), 0.0))


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


def _widen(band: dict[str, np.ndarray], bias_nm: np.ndarray) -> None:
    """Widen the whole band by what the smoothness penalty may hide at a bend."""
    for side, sign in (("whole_lower", -1.0), ("whole_upper", 1.0)):
        band[side] = band["value"] + sign * (np.abs(band[side] - band["value"]) + BENT * np.abs(bias_nm))


def whole_factor(matrix: np.ndarray, sd: np.ndarray) -> float:
    """Number of standard deviations within which 95 % of whole curves drawn from the covariance lie."""
    known = sd > 1e-9 * max(float(sd.max()), 1e-300)
    if not known.any():
        return POINTWISE
    scaled = matrix[np.ix_(known, known)] / sd[known][:, None] / sd[known][None, :]
    values, vectors = np.linalg.eigh(scaled)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    farthest = np.sort(np.max(np.abs(_draws(root.shape[1]) @ root.T), axis=1))
    return float(np.interp(0.95 * (DRAWS - 1), np.arange(DRAWS), farthest))


@cache
def _draws(size: int) -> np.ndarray:
    """Normal random numbers, always the same, so that a record always gives the same band."""
    return np.random.default_rng(1).standard_normal((DRAWS, size))
