"""Ramp deconvolution (section IV.A of the paper; Durfee & MacLean 1989): given dynamics, recruitment from one ramp.

The linear activation dynamics are critically damped with a natural frequency from the literature, 0.85π rad/s (31).
The torque of the triangular ramp is deconvolved with them; against pulse width that gives two recruitment curves, one
for the rising and one for the falling half; the sigmoid (30) is fitted to both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of, runs
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.second_order import boundary_states
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.finish import completed
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import near_rest, quiet_level, segment_rows
from stimrig.identify.model import Model, Noise
from stimrig.identify.noise import correlation
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SigmoidBasis, SplineBasis, fit_sigmoid
from stimrig.identify.recruitment.smoothing import choose_weight

NATURAL_FREQUENCY_RAD_S = 0.85 * np.pi
KNOTS_PER_S = 6.0


def fit(grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
    """Fit; `fit_on` names the ramp if it is not called `ramp`."""
    frequency = float(options.get("natural_frequency_rad_s", NATURAL_FREQUENCY_RAD_S))
    if not 0.05 <= frequency <= 100.0:
        fix = "Give 0.05 to 100 rad/s."
        raise BadRequest(f"{frequency:g} rad/s is out of range", place="natural_frequency_rad_s", fix=fix)
    ramp = segment_rows(grid, fit_on or ("ramp",), METHOD.id)
    if np.unique(grid.pulse_width_us[ramp]).size < 8:
        fix = "Record a triangular ramp over the whole range."
        raise NotIdentifiable("the ramp has fewer than 8 pulse widths", fix=fix)
    linear = SecondOrder(1.0 / frequency, 1.0)
    drive, baseline = deconvolved(grid, ramp, linear)
    width, slope = grid.pulse_width_us, np.gradient(grid.pulse_width_us)
    halves = {"rising": ramp & (slope > 0), "falling": ramp & (slope < 0)}
    ramp_us = width[ramp]

    def with_gain(basis: SigmoidBasis) -> Curve:
        column = basis.design(ramp_us)[:, 0]
        return Curve(basis, np.array([column @ drive[ramp] / max(float(column @ column), 1e-300)]))

    curve = with_gain(fit_sigmoid(lambda s: drive[ramp] - with_gain(s)(ramp_us), ramp_us, float(np.max(ramp_us))))
    residual = np.nan_to_num(grid.torque_nm) - baseline - linear.on_grid(grid, curve(width))
    rows = near_rest(grid, ramp)
    ar1 = correlation(residual, ends_of(runs(rows)), grid.step_s)
    model = Model(
        method=METHOD.id,
        recruitment=curve,
        linear=linear,
        pulse_rate_hz=1.0 / grid.step_s,
        sample_rate_hz=grid.record.sample_rate_hz,
        baseline_nm=baseline,
        noise=Noise(block_sd_nm=float(np.std(residual[rows])), ar1=ar1),
        reasons=(f"given dynamics: critically damped, {frequency:.4g} rad/s",),
        extra={"deconvolved": {half: _curve(width[rows], drive[rows]) for half, rows in halves.items()}},
    )
    return completed(model, grid, rows, 5.0)


METHOD = Method(
    "ramp-deconvolution",
    "The ramp deconvolved with critically damped dynamics of given frequency, then the sigmoid (30).",
    {"natural_frequency_rad_s": "1/Tω of the critically damped dynamics (default: 0.85π = 2.67)"},
    fit,
)


def deconvolved(grid: Grid, ramp: np.ndarray, linear: SecondOrder) -> tuple[np.ndarray, float]:
    """The drive w(t) whose response is the measured torque, N·m, shape (K,), and the baseline.

    Inverting (31) needs two derivatives of a noisy torque. Instead, w is a spline in time whose response through G is
    fitted to the torque, with a smoothness chosen by REML. This gives the same curve without amplified noise.
    """
    first, last = int(np.flatnonzero(ramp)[0]), int(np.flatnonzero(ramp)[-1])
    rows = near_rest(grid, ramp) & (np.arange(grid.size) >= first)
    span = (last - first + 1) * grid.step_s
    basis = SplineBasis(np.linspace(0.0, span, max(int(KNOTS_PER_S * span), 8)))
    # SplineBasis is zero at zero, as w is at the start of the ramp.
    columns = basis.design(np.clip((np.arange(grid.size) - first) * grid.step_s, 0.0, span))
    columns[last + 1 :] = 0.0
    # The torque that is left from earlier stimulation at the start of the ramp decays by the same dynamics.
    decaying, idle = np.zeros((grid.size, 2)), np.zeros((1, grid.size - first))
    for column, state in enumerate(np.eye(2)):
        states = boundary_states(linear.core, grid.step_s, idle, (state[0], state[1]))
        decaying[first:, column] = states[0][0, :-1]
    baseline = quiet_level(grid)
    design = np.c_[linear.on_grid(grid, columns), decaying][rows]
    target = grid.torque_nm[rows] - baseline
    size = basis.size
    gram, moment = design.T @ design, design.T @ target
    outer = np.linalg.solve(gram[size:, size:], np.c_[gram[size:, :size], moment[size:]])
    inner = gram[:size, :size] - gram[:size, size:] @ outer[:, :-1]
    right = moment[:size] - gram[:size, size:] @ outer[:, -1]
    energy = float(target @ target - moment[size:] @ outer[:, -1])
    weight = choose_weight(inner, right, energy, target.size, basis.roughness, 2).weight
    penalty = np.zeros_like(gram)
    penalty[:size, :size] = weight * basis.roughness + 1e-12 * np.trace(inner) / size * np.eye(size)
    return columns @ np.linalg.solve(gram + penalty, moment)[:size], baseline


def _curve(width_us: np.ndarray, drive_nm: np.ndarray) -> dict[str, list[float]]:
    order = np.argsort(width_us)
    return {"pulse_width_us": width_us[order].tolist(), "torque_nm": drive_nm[order].tolist()}
