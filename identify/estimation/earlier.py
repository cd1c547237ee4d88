"""Prior from earlier sessions of a person: the last approved model, widened by the usual change between sessions.

Between two sessions the electrodes move and the muscle is another day's: gain, threshold, width of the rise and speed
change. By how much is learnt from a person's own models (`learn_change`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadRequest
from stimrig.identify.model import Model
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.near_shape import KNOTS, Deviation, NearShape, dense_knots

EARLIER_DEVIATIONS = (Deviation(0.05, 1.0), Deviation(0.3, 0.8), Deviation(0.9, 0.8), Deviation(2.2, 0.2))
"""As `DEVIATIONS`, from the earlier curve: the posterior decides how far the shape itself changed."""
MAX_SD_SHARE = 1.5
"""Largest standard deviation of the log of a step that is taken from the last model."""


@dataclass(frozen=True)
class Change:
    """Standard deviations of what changes from one session to the next."""

    gain_log: float = 0.25  # of the log of the curve's gain
    middle_us: float = 12.0  # of the pulse width in the middle of the rise, µs
    width_log: float = 0.12  # of the log of the width of the rise
    time_constant_log: float = 0.12  # of the log of T
    damping_log: float = 0.10  # of the log of ζ
    sessions: int = 0  # number of earlier models that it was learnt from; 0 for the default


USUAL = Change()
USUAL_WEIGHT = 3.0
"""The usual change counts like this many differences between sessions of the person's own."""


def learn_change(models: Sequence[Model]) -> Change:
    """Estimate how much a person changes between sessions, from their own approved models, oldest first.

    Each standard deviation is that of the differences between successive models, with the usual change as a prior that
    counts like three differences. With fewer than two models it is the usual change.

    `models`: with second-order dynamics; others are left out.
    """
    known = [Earlier(model) for model in models if isinstance(model.linear, SecondOrder) and _curve_marks(model)]
    if len(known) < 2:
        return USUAL
    marks = np.array([[*earlier.mean, *np.log(earlier.linear.core)] for earlier in known])
    squares = np.sum(np.diff(marks, axis=0) ** 2, axis=0)
    usual = np.array([USUAL.gain_log, USUAL.middle_us, USUAL.width_log, USUAL.time_constant_log, USUAL.damping_log])
    sd = np.sqrt((USUAL_WEIGHT * usual**2 + squares) / (USUAL_WEIGHT + len(known) - 1))
    return Change(*(float(value) for value in sd), sessions=len(known))


def _curve_marks(model: Model) -> tuple[float, float, float, float] | None:
    """Plateau, N·m, and the widths at 10, 50 and 90 % of it, µs; None if the curve does not rise."""
    u, torque = model.recruitment.table()
    rising = np.maximum.accumulate(np.abs(torque))
    if not rising[-1] > 0.0:
        return None
    at = [float(u[np.argmax(rising >= share * rising[-1])]) for share in (0.1, 0.5, 0.9)]
    return float(rising[-1]), *at  # type: ignore


@dataclass(frozen=True)
class Earlier:
    """A person as known before a session.

    Raises BadRequest: the model is of another kind, or its curve does not rise.
    """

    model: Model  # the last approved one, with second-order dynamics
    change: Change = USUAL  # by how much it is widened

    def __post_init__(self) -> None:
        if not isinstance(self.model.linear, SecondOrder) or _curve_marks(self.model) is None:
            message = "the earlier model has no second-order dynamics or no rising curve"
            raise BadRequest(message, place="earlier", fix="Give a model of the method maximum-likelihood, or none.")

    @property
    def linear(self) -> SecondOrder:
        """Dynamics of the last model."""
        assert isinstance(self.model.linear, SecondOrder)
        return self.model.linear

    @property
    def largest_us(self) -> float:
        """Largest width of the last model, µs."""
        return self.model.recruitment.basis.largest_us

    @cached_property
    def _marks(self) -> tuple[float, float, float, float]:
        marks = _curve_marks(self.model)
        assert marks is not None
        return marks

    @property
    def mean(self) -> np.ndarray:
        """Log gain, middle, µs, and log width, µs, of the last model."""
        gain, low, middle, high = self._marks
        return np.array([np.log(gain), middle, np.log(max(high - low, 1.0))])

    @cached_property
    def _standard(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The last curve in standard units (0 at the middle, 1 long from 10 to 90 %): places, values and slopes."""
        gain, low, middle, high = self._marks
        u, torque = self.model.recruitment.table()
        x, value = (u - middle) / max(high - low, 1.0), np.maximum.accumulate(np.abs(torque)) / gain
        return x, value, np.gradient(value, x)

    def shape(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Value and slope of the last curve in standard units."""
        at, value, slope = self._standard
        return np.interp(x, at, value), np.interp(x, at, slope, left=0.0, right=0.0)

    def curve_prior(self, largest_us: float, knots: int = KNOTS) -> NearShape:
        """The prior of this session's curve."""
        _, low, middle, high = self._marks
        rise = max(high - low, 0.02 * largest_us)
        basis = SplineBasis(dense_knots(largest_us, middle, rise, knots))
        sd = np.array([self.change.gain_log, self.change.middle_us, self.change.width_log])
        model_sd = np.array([self._sd("plateau_nm") / self._marks[0], 0.0, 0.0])
        plateau = float(self.mean[0]), 2.0 * float(np.hypot(sd[0], model_sd[0]))
        precision = np.diag(1.0 / (sd**2 + model_sd**2))
        prior = NearShape(basis, self.shape, self.mean, precision, plateau, rise, EARLIER_DEVIATIONS)
        return replace(prior, shape_covariance=self._step_covariance(prior))

    def _step_covariance(self, prior: NearShape) -> np.ndarray | None:
        """Covariance of the logs of the steps, from that of the last curve's coefficients.

        Where a step may as well be many times as large, as below the widths that were played, its logarithm has no
        such covariance: there the prior's own doubt of the shape is all.
        """
        known, basis = self.model.curve_covariance, self.model.recruitment.basis
        if known is None:
            return None
        slopes = np.diff(basis.design(np.minimum(prior.places_us, basis.largest_us)), axis=0)
        covariance = slopes @ known @ slopes.T
        steps = np.exp(prior.log_steps(prior.mean))
        size = np.maximum(prior.blurred(steps), 1e-9 * steps.sum())
        determined = np.sqrt(np.maximum(np.diag(covariance), 0.0)) <= MAX_SD_SHARE * size
        return np.where(determined[:, None] & determined[None, :], covariance / size[:, None] / size[None, :], 0.0)

    def dynamics(self, delay_sd_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean and precision of (log T, log ζ, delay)."""
        t, z = self.linear.core
        model_sd = np.array([self._sd("time_constant_s") / t, self._sd("damping") / z, 0.0])
        sd = np.array([self.change.time_constant_log, self.change.damping_log, delay_sd_s])
        return np.array([np.log(t), np.log(z), 0.0]), np.diag(1.0 / (sd**2 + model_sd**2))

    def _sd(self, name: str) -> float:
        return float(self.model.figures()[name]["sd"] or 0.0)
