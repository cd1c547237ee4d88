"""What is tracked from trial to trial, how it changes, and one step of the Kalman filter.

Three levels, relative to the approved model: the log of the gain, the shift of the threshold (µs) and the log of the
time scale. Each has a trend: a level changes by its trend and by a step without memory, and the trend turns slowly.
This is the local linear trend model (Harvey 1989, Forecasting, structural time series models and the Kalman filter,
2.3). One odd trial moves no level by more than its band. If the next one says the same, it was a change, and it is
followed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

QUANTITIES = ("gain", "threshold_shift_us", "time_scale")
LEVELS = len(QUANTITIES)
SURPRISING = 11.3
"""Squared distance, in standard deviations of the prediction, beyond which a trial is odd (p = 0.01 for three)."""
MOST_BY_ODD = 1.9
"""Most that an odd trial moves, in standard deviations of what was expected: less than the band of 95 %."""


def _row(*values: float) -> np.ndarray:
    return np.array(values, float)


@dataclass(frozen=True)
class Rates:
    """How fast a person changes, in the units of the levels (log gain, µs, log time scale); arrays of shape (3,).

    Parameters
    ----------
    start : ndarray
        Standard deviation of the first trial's levels: what the approved model does not know.
    step : ndarray
        Standard deviation of a change from one trial to the next that has no trend.
    trend : ndarray
        Mean trend at the first trial, per trial.
    trend_sd, turn : ndarray
        Standard deviations of the first trend, and of its change from trial to trial.
    sessions : int
        Sessions that they were learnt from; 0 for the usual ones.
    """

    start: np.ndarray = field(default_factory=lambda: _row(0.08, 6.0, 0.10))
    step: np.ndarray = field(default_factory=lambda: _row(0.006, 0.5, 0.008))
    trend: np.ndarray = field(default_factory=lambda: np.zeros(LEVELS))
    trend_sd: np.ndarray = field(default_factory=lambda: _row(0.025, 1.2, 0.012))
    turn: np.ndarray = field(default_factory=lambda: _row(0.008, 0.5, 0.005))
    sessions: int = 0


USUAL = Rates()


@dataclass(frozen=True)
class Values:
    """Gain and time scale as factors on the approved model's, the shift of its threshold in µs."""

    gain: float = 1.0
    threshold_shift_us: float = 0.0
    time_scale: float = 1.0

    @classmethod
    def of(cls, levels: np.ndarray) -> Values:
        """From log gain, µs, log time scale."""
        return cls(float(np.exp(levels[0])), float(levels[1]), float(np.exp(levels[2])))

    @property
    def levels(self) -> np.ndarray:
        """Log gain, µs, log time scale, shape (3,)."""
        return np.array([np.log(self.gain), self.threshold_shift_us, np.log(self.time_scale)])


@dataclass(frozen=True)
class State:
    """What is known of the levels and their trends.

    Parameters
    ----------
    mean : ndarray, shape (6,)
        Three levels, three trends.
    covariance : ndarray, shape (6, 6)
        Its covariance.
    trials : int
        Trials that it was learnt from.
    odd : ndarray, shape (3,) or None
        The last trial's innovation if it was odd.
    unexplained : int
        Trials since the last one that gain, threshold and speed explained.
    """

    mean: np.ndarray
    covariance: np.ndarray
    trials: int = 0
    odd: np.ndarray | None = None
    unexplained: int = 0

    @classmethod
    def start(cls, rates: Rates = USUAL) -> State:
        """Before the first trial."""
        mean = np.r_[np.zeros(LEVELS), rates.trend]
        return cls(mean, np.diag(np.r_[rates.start, rates.trend_sd] ** 2))

    @property
    def values(self) -> Values:
        """The levels in their units."""
        return Values.of(self.mean[:LEVELS])

    def band(self, quantity: int, sds: float = 1.96) -> tuple[float, float]:
        """Lower and upper end of a quantity's band, in its unit."""
        half = sds * float(np.sqrt(self.covariance[quantity, quantity]))
        ends = np.array([self.mean[quantity] - half, self.mean[quantity] + half])
        low, high = ends if QUANTITIES[quantity].endswith("_us") else np.exp(ends)
        return float(low), float(high)

    def ahead(self, rates: Rates = USUAL) -> State:
        """Before the next trial."""
        move = np.eye(2 * LEVELS)
        move[:LEVELS, LEVELS:] = np.eye(LEVELS)
        spread = np.diag(np.r_[rates.step, rates.turn] ** 2)
        return replace(self, mean=move @ self.mean, covariance=move @ self.covariance @ move.T + spread)

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "mean": self.mean.tolist(),
            "covariance": self.covariance.tolist(),
            "trials": self.trials,
            "odd": None if self.odd is None else self.odd.tolist(),
            "unexplained": self.unexplained,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> State:
        """The state that `to_dict` wrote."""
        odd = data.get("odd")
        return cls(
            np.array(data["mean"], float),
            np.array(data["covariance"], float),
            int(data["trials"]),
            None if odd is None else np.array(odd, float),
            int(data["unexplained"]),
        )


def updated(before: State, seen: np.ndarray, information: np.ndarray) -> tuple[State, float]:
    """The state after a trial, and how odd the trial was.

    Parameters
    ----------
    before : State
        Before the trial.
    seen : ndarray, shape (3,)
        The levels that explain the trial best.
    information : ndarray, shape (3, 3)
        Inverse of their covariance; zero in a direction of which the trial tells nothing.

    Returns
    -------
    State
        After the trial.
    float
        Squared distance of what was seen from what was expected, in standard deviations; about 3 on average if the
        trial tells something of all three.
    """
    away = seen - before.mean[:LEVELS]
    expected = before.covariance[:LEVELS, :LEVELS]
    distance = float(away @ _gain(expected, information) @ away)
    covariance = before.covariance
    if distance > SURPRISING:
        again = before.odd is not None and float(before.odd @ _gain(expected, information) @ away) > 0.5 * distance
        if not again:
            # No further than the band of what was expected, and nothing is known better than before.
            move = covariance[:, :LEVELS] @ _gain(expected, information) @ away * (MOST_BY_ODD / np.sqrt(distance))
            return replace(before, mean=before.mean + move, trials=before.trials + 1, odd=away, unexplained=0), distance
        covariance = covariance.copy()
        covariance[:LEVELS, :LEVELS] += np.outer(away, away)
    gain = _gain(covariance[:LEVELS, :LEVELS], information)
    lever = covariance[:, :LEVELS]
    after = covariance - lever @ gain @ lever.T
    return State(before.mean + lever @ gain @ away, 0.5 * (after + after.T), before.trials + 1), distance


def _gain(expected: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Inverse of the covariance of what is seen; it exists too where a trial tells nothing."""
    return np.linalg.solve(np.eye(LEVELS) + information @ expected, information)
