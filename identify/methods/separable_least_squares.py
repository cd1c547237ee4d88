"""Separable least squares (section IV.B of the paper; Westwick & Kearney 2001): impulse response times sigmoid.

The model (32) is linear in the weights of the impulse response, and nonlinear only in the shape of the sigmoid: the
shape is searched, the weights are solved for. The paper uses 41 taps, which is 1 s at 40 Hz and shorter than the memory
of the muscle. `memory_s` gives the length in seconds instead.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.finish import finish_discrete
from stimrig.identify.estimation.samples import fitted_rows
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import shifted
from stimrig.identify.model import Model
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import SigmoidBasis, fit_sigmoid

TAPS = 41


def fit(grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
    """Fit on the named segments, or on all that may be fitted."""
    if "taps" in options and "memory_s" in options:
        raise BadRequest("both taps and memory_s are given", place="options", fix="Give one of them.")
    taps = int(options.get("taps", TAPS))
    if "memory_s" in options:
        taps = round(float(options["memory_s"]) / grid.step_s) + 1
    if not 2 <= taps <= 2000:
        raise BadRequest(f"{taps} taps is out of range", place="taps", fix="Give 2 to 2000.")
    rows = fitted_rows(grid, fit_on)
    if rows.sum() <= taps + 4:
        fix = "Record longer, or use fewer taps."
        raise NotIdentifiable(f"{int(rows.sum())} pulse intervals are too few for {taps} taps", fix=fix)
    widths_us = grid.pulse_width_us[rows]
    if not np.ptp(widths_us) > 0:
        raise NotIdentifiable("the pulse width never changes", fix="Record a PRBS and a ramp.")
    basis, response = separate(grid, rows, taps)
    gain = float(response.sum())
    block = Discrete(tuple(response / gain), (1.0,), 0, grid.step_s, float(np.mean(grid.fraction)))
    reasons = [f"{taps} taps: a memory of {(taps - 1) * grid.step_s:.3g} s"]
    return finish_discrete(METHOD.id, grid, rows, block, Curve(basis, np.array([gain])), reasons)


METHOD = Method(
    "separable-least-squares",
    "Finite impulse response (41 taps) behind the sigmoid (30), by separable least squares.",
    {"taps": "length of the impulse response in pulses (default: 41)", "memory_s": "or its length in seconds"},
    fit,
)


def separate(grid: Grid, rows: np.ndarray, taps: int) -> tuple[SigmoidBasis, np.ndarray]:
    """The shape, and the impulse response in N·m per unit of it, shape (taps,)."""
    torque, width = grid.torque_nm[rows], grid.pulse_width_us
    levels, place = np.unique(width, return_inverse=True)

    def design(basis: SigmoidBasis) -> np.ndarray:
        drive = grid.interval_means(basis.design(levels)[:, 0][place])
        return np.stack([*(shifted(drive, lag)[rows] for lag in range(taps)), np.ones(int(rows.sum()))], axis=1)

    def solve(basis: SigmoidBasis) -> tuple[np.ndarray, np.ndarray]:
        columns = design(basis)
        gram = columns.T @ columns
        # A very small ridge: a tap that the input never excites stays at zero.
        ridge = 1e-10 * np.trace(gram) / len(gram) * np.eye(len(gram))
        weights = np.linalg.solve(gram + ridge, columns.T @ torque)
        return weights, torque - columns @ weights

    basis = fit_sigmoid(lambda shape: solve(shape)[1], width[rows], float(np.max(width)))
    return basis, solve(basis)[0][:-1]
