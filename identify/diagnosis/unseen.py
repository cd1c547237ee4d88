"""What rows not seen say of a model: its error there beside what the noise and the model's own band allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.diagnosis.thresholds import FORM, LEAST_UNSEEN_ROWS, NEAR, UNSEEN_RISE
from identify.dynamics.pulse_grid import Grid
from identify.effects import get
from identify.estimation.joint import Fitted
from identify.records.record import FORGOTTEN_S

MEDIAN = 0.6745
"""Median of the size of normal errors over their standard deviation."""


@dataclass(frozen=True)
class Unseen:
    """The error of one model on the intervals held out.

    Parameters
    ----------
    rms_nm : float
        Error of the intervals' means, N·m.
    allowed_nm : float
        What noise as in the fitted rows and the uncertainty of the model's parameters give there, N·m.
    """

    rms_nm: float
    allowed_nm: float

    @property
    def excess_nm(self) -> float:
        """Error beyond what is allowed, N·m."""
        return float(np.sqrt(max(self.rms_nm**2 - self.allowed_nm**2, 0.0)))

    @property
    def ratio(self) -> float:
        """Error over what is allowed."""
        return self.rms_nm / self.allowed_nm


def unseen(fitted: Fitted, form: float = FORM, beside: Fitted | None = None) -> Unseen | None:
    """The model on the intervals held out; None where there are none, or where a tremor is everywhere.

    Rows count whose pulse widths, and those of the last seconds, were fitted: elsewhere the curve is a guess.

    `form` is what the form of the model may err by there, as a share of the largest torque.
    Efforts cannot be foreseen, but they are seldom: where the model or the one beside it holds one, the median error
    counts.
    """
    setup = fitted.problem.setup
    grid = setup.grid
    rows = grid.held_out & ~grid.doubted & (2 * grid.count >= np.median(grid.count[setup.fitted]))
    rows &= _covered(grid, setup.fitted)
    if rows.sum() < LEAST_UNSEEN_ROWS or fitted.noise.band > 0.0:
        return None
    residual = fitted.residual_nm[rows]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    scaled = fitted.hessian * scale[:, None] * scale[None, :] + 1e-12 * np.eye(scale.size)
    slopes = fitted.slopes[:, rows] * scale[:, None]
    band = np.sum(slopes * np.linalg.solve(scaled, slopes), axis=0)
    allowed = np.sqrt(fitted.noise.sd_nm**2 + float(np.mean(band)) + (form * setup.scale_nm) ** 2)
    if all(get(effect).foreseeable for effect, _ in [*fitted.effects, *(beside.effects if beside else [])]):
        return Unseen(float(np.sqrt(np.mean(residual**2))), float(allowed))
    return Unseen(float(np.median(np.abs(residual)) / MEDIAN), float(allowed))


def rise(before: Fitted, after: Fitted) -> tuple[float, float] | None:
    """Errors on the intervals held out, N·m, without and with an effect, where they rise and so speak against it."""
    old, new = unseen(before, beside=after), unseen(after)
    if old is None or new is None or new.rms_nm <= UNSEEN_RISE * max(old.rms_nm, new.allowed_nm):
        return None
    return old.rms_nm, new.rms_nm


def _covered(grid: Grid, fitted: np.ndarray) -> np.ndarray:
    """bool, shape (K,): intervals before which, as long as a muscle remembers, all widths are among those fitted."""
    widths = np.unique(grid.pulse_width_us[fitted])
    if widths.size < 2:
        return np.zeros(grid.size, bool)
    after = np.clip(np.searchsorted(widths, grid.pulse_width_us), 1, widths.size - 1)
    near = np.minimum(np.abs(grid.pulse_width_us - widths[after]), np.abs(grid.pulse_width_us - widths[after - 1]))
    strange = near > NEAR * float(widths[-1])
    memory = round(FORGOTTEN_S / grid.step_s)
    return np.convolve(strange, np.ones(memory))[: grid.size] < 0.5
