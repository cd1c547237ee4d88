"""The error of a model on held-out rows, and the error that noise and the model's uncertainty allow there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.diagnosis.thresholds import FORM_ERROR, HELD_OUT_RISE, LEAST_HELD_OUT_ROWS, NEAR
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import get
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.records.record import FORGOTTEN_S

MEDIAN = 0.6745
"""Median of the size of normal errors over their standard deviation."""


@dataclass(frozen=True)
class HeldOutError:
    """The error of one model on the intervals held out.

    Parameters
    ----------
    rms_nm : float
        Error of the intervals' means, N·m.
    allowed_nm : float
        Error that the noise of the fitted rows and the uncertainty of the parameters explain there, N·m.
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


def held_out_error(fitted: Fitted, form: float = FORM_ERROR, beside: Fitted | None = None) -> HeldOutError | None:
    """The error on the held-out intervals; None if there are too few, or if there is a tremor.

    Only rows count whose pulse widths, and those of the seconds before, are near fitted ones: elsewhere the recruitment
    curve is a guess. Efforts cannot be predicted, but they are rare: if one of the models has one, the median of the
    error counts instead of its root mean square.

    Parameters
    ----------
    fitted : Fitted
        The model.
    form : float
        Error allowed because the model's form is inexact, as a share of the largest torque.
    beside : Fitted or None
        A model that this one is compared with.
    """
    setup = fitted.problem.setup
    grid = setup.grid
    rows = grid.held_out & ~grid.doubted & (2 * grid.count >= np.median(grid.count[setup.fitted]))
    rows &= _covered(grid, setup.fitted)
    if rows.sum() < LEAST_HELD_OUT_ROWS or fitted.noise.band > 0.0:
        return None
    residual = fitted.residual_nm[rows]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    scaled = fitted.hessian * scale[:, None] * scale[None, :] + 1e-12 * np.eye(scale.size)
    slopes = fitted.slopes[:, rows] * scale[:, None]
    band = np.sum(slopes * np.linalg.solve(scaled, slopes), axis=0)
    allowed = np.sqrt(fitted.noise.sd_nm**2 + float(np.mean(band)) + (form * setup.scale_nm) ** 2)
    if all(get(effect).predictable for effect, _ in [*fitted.effects, *(beside.effects if beside else [])]):
        return HeldOutError(float(np.sqrt(np.mean(residual**2))), float(allowed))
    return HeldOutError(float(np.median(np.abs(residual)) / MEDIAN), float(allowed))


def held_out_rise(before: Fitted, after: Fitted) -> tuple[float, float] | None:
    """Errors on held-out rows without and with an effect, N·m, if they rise and so speak against it; else None."""
    old, new = held_out_error(before, beside=after), held_out_error(after)
    if old is None or new is None or new.rms_nm <= HELD_OUT_RISE * max(old.rms_nm, new.allowed_nm):
        return None
    return old.rms_nm, new.rms_nm


def _covered(grid: Grid, fitted: np.ndarray) -> np.ndarray:
    """bool, shape (K,): intervals whose width, and all widths within the muscle's memory before, are near fitted
    ones."""
    widths = np.unique(grid.pulse_width_us[fitted])
    if widths.size < 2:
        return np.zeros(grid.size, bool)
    after = np.clip(np.searchsorted(widths, grid.pulse_width_us), 1, widths.size - 1)
    near = np.minimum(np.abs(grid.pulse_width_us - widths[after]), np.abs(grid.pulse_width_us - widths[after - 1]))
    strange = near > NEAR * float(widths[-1])
    memory = round(FORGOTTEN_S / grid.step_s)
    return np.convolve(strange, np.ones(memory))[: grid.size] < 0.5
