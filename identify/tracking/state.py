"""The quantities that are tracked from trial to trial, how they change, and one step of the Kalman filter.

Three levels, relative to the approved model: the log of the gain, the shift of the threshold (µs) and the log of the
time scale. Each has a trend: a level changes by its trend and by a step without memory, and the trend turns slowly.
This is the local linear trend model (Harvey 1989, Forecasting, structural time series models and the Kalman filter,
2.3). Beside them stands what the approved curve has wrong, one number for each of its coefficients. That does not
change from trial to trial; without it, an error in the curve's shape would look like a change of the muscle.

One odd trial moves no level by more than its band. If the next one says the same, it was a change, and it is followed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stimrig.identify.json_text import json_value

QUANTITIES = ("gain", "threshold_shift_us", "time_scale")
LEVELS = len(QUANTITIES)
CURVE = 2 * LEVELS
"""Where the curve begins in a state."""
SURPRISING = 11.3
"""Squared distance, in standard deviations of the prediction, beyond which a trial is odd (p = 0.01 for three)."""
MOST_BY_ODD = 1.9
"""Most that an odd trial moves, in standard deviations of what was expected: less than the band of 95 %."""


@dataclass(frozen=True)
class Rates:
    """Rates of a person's change, in the units of the levels (log gain, µs, log time scale); arrays of shape (3,)."""

    start: np.ndarray  # standard deviation of the first trial's levels: what the approved model does not know
    step: np.ndarray  # standard deviation of a change from one trial to the next that has no trend
    trend: np.ndarray  # mean trend at the first trial, per trial
    trend_sd: np.ndarray  # standard deviation of the first trend
    turn: np.ndarray  # standard deviation of its change from trial to trial


USUAL = Rates(
    start=np.array([0.08, 6.0, 0.10]),
    step=np.array([0.006, 0.5, 0.008]),
    trend=np.zeros(LEVELS),
    trend_sd=np.array([0.04, 1.2, 0.012]),  # a muscle that loses 40 % in ten trials begins with -0.055: no surprise
    turn=np.array([0.008, 0.5, 0.005]),
)


def values_of(levels: np.ndarray) -> dict[str, float]:
    """By quantity: factors on the approved gain and time scale, and the shift of the threshold, µs."""
    gain_log, shift_us, time_log = levels[:LEVELS].tolist()
    return dict(zip(QUANTITIES, (float(np.exp(gain_log)), shift_us, float(np.exp(time_log))), strict=True))


@dataclass(frozen=True)
class State:
    """Estimate of the levels, their trends and the curve.

    `mean`, shape (6 + n,), holds three levels, three trends, and corrections of the n coefficients of the approved
    curve, N·m.
    """

    mean: np.ndarray  # of levels, trends and curve
    covariance: np.ndarray  # of the same
    trials: int = 0  # that it was learnt from
    odd: np.ndarray | None = None  # how far the last trial would have moved the levels, if it was odd
    unexplained: int = 0  # trials since the last one that gain, threshold and speed explained
    effects: Mapping[str, float] = field(default_factory=dict)  # slow states at the end of what was seen last, 0 to 1
    ended_s: float | None = None  # when that was, as Unix time; None: not known

    @classmethod
    def start(cls, curve_covariance: np.ndarray, rates: Rates = USUAL) -> State:
        """Before the first trial; `curve_covariance` is that of the approved curve's coefficients, (N·m)²."""
        size = len(curve_covariance)
        covariance = np.zeros((CURVE + size, CURVE + size))
        covariance[:CURVE, :CURVE] = np.diag(np.r_[rates.start, rates.trend_sd] ** 2)
        covariance[CURVE:, CURVE:] = curve_covariance
        return cls(np.r_[np.zeros(LEVELS), rates.trend, np.zeros(size)], covariance)

    @property
    def values(self) -> dict[str, float]:
        """By quantity, its value: gain and time scale as factors, the threshold's shift in µs."""
        return values_of(self.mean)

    @property
    def observed(self) -> np.ndarray:
        """Indices of the elements of `mean` that a trial observes: levels and curve, not the trends."""
        return np.r_[np.arange(LEVELS), np.arange(CURVE, self.mean.size)]

    def bands(self) -> dict[str, dict[str, float]]:
        """`value`, `low` and `high` (95 %) of each quantity."""
        half = 1.96 * np.sqrt(np.diag(self.covariance))
        ends = {"value": self.values, "low": values_of(self.mean - half), "high": values_of(self.mean + half)}
        return {name: {end: values[name] for end, values in ends.items()} for name in QUANTITIES}

    def predicted(self, rates: Rates = USUAL) -> State:
        """Prediction for the next trial."""
        move = np.eye(self.mean.size)
        move[:LEVELS, LEVELS:CURVE] = np.eye(LEVELS)
        spread = np.diag(np.r_[rates.step, rates.turn, np.zeros(self.mean.size - CURVE)] ** 2)
        return replace(self, mean=move @ self.mean, covariance=move @ self.covariance @ move.T + spread)

    def updated(self, vector: np.ndarray, information: np.ndarray) -> tuple[State, float]:
        """The state after a trial, and how odd the trial was.

        `information`: inverse of the covariance of the levels and the curve that explain the trial best; zero in a
        direction that the trial does not observe. `vector`: information times those levels and that curve.

        How odd: the squared distance by which the trial moves the levels, in the standard deviations that are expected
        of such a move; about 3 on average if the trial observes all three.
        """
        after = self._filtered(vector, information)
        move = (after.mean - self.mean)[:LEVELS]
        allowed = (self.covariance - after.covariance)[:LEVELS, :LEVELS]
        whitened = np.linalg.pinv(allowed, rcond=1e-6, hermitian=True) @ move
        distance = max(float(move @ whitened), 0.0)
        if distance <= SURPRISING:
            return after, distance
        if self.odd is None or not float(self.odd @ whitened) > 0.5 * distance:
            # No further than the band of what was expected, and nothing is known better than before.
            mean = self.mean + (after.mean - self.mean) * (MOST_BY_ODD / np.sqrt(distance))
            return replace(self, mean=mean, trials=self.trials + 1, odd=move, unexplained=0), distance
        wider = self.covariance.copy()
        wider[:LEVELS, :LEVELS] += np.outer(move, move)
        return replace(self, covariance=wider)._filtered(vector, information), distance

    def _filtered(self, vector: np.ndarray, information: np.ndarray) -> State:
        """Kalman update in information form; it also exists where a trial observes nothing."""
        lever = self.covariance[:, self.observed]
        expected = lever[self.observed]
        solve = np.linalg.solve(np.eye(self.observed.size) + information @ expected, np.c_[information, vector])
        away = solve[:, -1] - solve[:, :-1] @ self.mean[self.observed]
        covariance = self.covariance - lever @ solve[:, :-1] @ lever.T
        return State(self.mean + lever @ away, 0.5 * (covariance + covariance.T), self.trials + 1)

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return json_value(vars(self))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> State:
        """The state that `to_dict` wrote."""
        known = [name for name in ("mean", "covariance", "odd") if data[name] is not None]
        return cls(**data | {name: np.array(data[name], float) for name in known})


# ---- how fast a person changes, learnt from earlier sessions of their own ----

BELIEVED_SESSIONS = 2.0
"""The usual start and the usual first trend count like this many sessions of the person's own."""
BELIEVED_TRIALS = 12.0
"""The usual steps and turns count like this many trials."""
FIRST = 3
"""Trials from which a session's first trend is taken."""


def learn_rates(sessions: Sequence[Sequence[Mapping[str, Mapping[str, Any]]]]) -> Rates:
    """The usual rates, corrected by what a person's earlier sessions say.

    `sessions`: for each earlier session its trials in order, each as `State.bands` returns them (`now` of
    `Step.to_dict`); those of fewer than three trials are not used. Each variance is a mean of the usual one and of the
    person's own, weighted by how many there are. The person's own holds the scatter of the trials, too.
    """
    known = []
    for session in (session for session in sessions if len(session) >= FIRST):
        gain, shift_us, scale = np.array([[float(trial[name]["value"]) for name in QUANTITIES] for trial in session]).T
        known.append(np.c_[np.log(gain), shift_us, np.log(scale)])
    if not known:
        return USUAL
    count = len(known)
    starts = np.array([levels[0] for levels in known])
    trends = np.array([(levels[FIRST - 1] - levels[0]) / (FIRST - 1) for levels in known])
    trend = trends.sum(axis=0) / (count + BELIEVED_SESSIONS)
    bends = np.concatenate([np.diff(levels, n=2, axis=0) for levels in known])
    usual = USUAL.turn**2 + 2.0 * USUAL.step**2  # of a bend, which holds one turn and two steps
    squares = BELIEVED_TRIALS * usual + np.sum(bends**2, axis=0)
    faster = np.sqrt(squares / ((BELIEVED_TRIALS + len(bends)) * usual))

    def pooled(usual_sd: np.ndarray, personal: np.ndarray) -> np.ndarray:
        squares = BELIEVED_SESSIONS * usual_sd**2 + np.sum(personal**2, axis=0)
        return np.sqrt(squares / (BELIEVED_SESSIONS + count))

    start, trend_sd = pooled(USUAL.start, starts), pooled(USUAL.trend_sd, trends - trend)
    return Rates(start, faster * USUAL.step, trend, trend_sd, faster * USUAL.turn)
