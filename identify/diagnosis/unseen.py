"""What rows not seen say of a model: its error there beside what the noise and the model's own band allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.diagnosis.thresholds import LEAST_ROWS, LEAST_WIDTHS
from identify.effects import get
from identify.estimation.joint import Fitted

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


def unseen(fitted: Fitted) -> Unseen | None:
    """The model on the intervals held out; None where there are none, or where a tremor is everywhere.

    None, too, where so few widths were fitted that the curve between them is a guess.

    Efforts cannot be foreseen, but they are seldom: beside them the error is that of most intervals, the median.
    """
    setup = fitted.problem.setup
    grid = setup.grid
    rows = grid.held_out & ~grid.doubted & (2 * grid.count >= np.median(grid.count[setup.fitted]))
    few = np.unique(grid.pulse_width_us[setup.fitted]).size < LEAST_WIDTHS
    if few or rows.sum() < LEAST_ROWS or fitted.noise.band > 0.0:
        return None
    residual = fitted.residual_nm[rows]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fitted.hessian), 1e-300))
    scaled = fitted.hessian * scale[:, None] * scale[None, :] + 1e-12 * np.eye(scale.size)
    slopes = fitted.slopes[:, rows] * scale[:, None]
    band = np.sum(slopes * np.linalg.solve(scaled, slopes), axis=0)
    allowed = np.sqrt(fitted.noise.sd_nm**2 + float(np.mean(band)))
    if all(get(effect).foreseeable for effect, _ in fitted.effects):
        return Unseen(float(np.sqrt(np.mean(residual**2))), float(allowed))
    return Unseen(float(np.median(np.abs(residual)) / MEDIAN), float(allowed))
