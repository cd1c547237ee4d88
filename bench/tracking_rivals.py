"""Who follows the model after each trial: ours, and peers. Each takes a trial's record and serves a MODEL.json.

A peer knows the approved model and the trials since, as ours does. It has no forecast: what it serves is what it knows
now. Its free settings (constants here) were chosen on seeds from 54000, each for its own best.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from stimrig import identify
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import IdentifyError
from stimrig.identify.model import Model
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Curve
from stimrig.identify.tracking import QUANTITIES, Values, follow, model_for_next, moved_model

PULSE_RATE_HZ = 40.0
FINE = 20


class Follower(Protocol):
    """Learns from trials, one after the other."""

    def learn(self, trial: Record) -> dict[str, Any]:
        """What is served after this trial: MODEL.json, with a key `tracking` if more is known than the model."""
        ...


def intervals(trial: Record) -> tuple[np.ndarray, np.ndarray]:
    """Width and mean torque above the first rest of each pulse's interval, µs and N·m."""
    each = round(trial.sample_rate_hz / PULSE_RATE_HZ)
    size = trial.time_s.size // each
    torque_nm = trial.torque_nm[: size * each].reshape(size, each).mean(axis=1)
    width_us = trial.pulse_width_us[: size * each : each]
    first = int(np.argmax(width_us > 0))
    return width_us, torque_nm - torque_nm[: max(first, 1)].mean()


def response(linear: SecondOrder, size: int) -> np.ndarray:
    """Mean torque of each interval after a drive that is held for one, shape (size,)."""
    time_s = np.arange(size * FINE + 1) / (FINE * PULSE_RATE_HZ)
    step = linear.step_response(time_s)
    means = (0.5 * (step[1:] + step[:-1])).reshape(size, FINE).mean(axis=1)
    return np.diff(means, prepend=0.0)


def driven(linear: SecondOrder, drive: np.ndarray) -> np.ndarray:
    """Means of the response to a drive, shape as `drive`: (N,) or (N, M)."""
    size = len(drive)
    steps = np.subtract.outer(np.arange(size), np.arange(size))
    return np.where(steps >= 0, response(linear, size)[np.abs(steps)], 0.0) @ drive


def noise_variance(error_nm: np.ndarray) -> float:
    """Of an independent interval: neighbouring errors that are alike count as fewer."""
    power = float(np.mean(error_nm**2)) + 1e-12
    alike = float(np.clip(np.mean(error_nm[1:] * error_nm[:-1]) / power, 0.0, 0.97))
    return power * (1.0 + alike) / (1.0 - alike)


class Ours:
    """`stimrig.identify.tracking`."""

    def __init__(self, model: Model, test: Record) -> None:  # noqa: ARG002
        self.model, self.state = model, None

    def learn(self, trial: Record) -> dict[str, Any]:
        """The approved model at its levels of the next trial, and its levels now."""
        return tracked(self, trial)


def tracked(ours: Any, trial: Record) -> dict[str, Any]:
    """What the service serves after a trial, made here from the recording."""
    step = follow(ours.model, ours.state, trial)
    ours.state = step.coming
    return model_for_next(ours.model, step).to_dict() | {"tracking": step.to_dict() | {"moved": list(QUANTITIES)}}


class Recursive:
    """Recursive least squares with forgetting, alternating between curve and dynamics.

    After Le, Markovsky, Freeman and Rogers (Control Engineering Practice 2012): given G, the curve's coefficients are
    linear in the torque; given f, the dynamics are estimated; each by a recursion that forgets. Three things are done
    better than by the letter. Both are fitted to the simulated output: with noise on the torque the equation error of
    an ARX regression is biased. G has the approved model's two parameters. And what is forgotten returns to the
    approved model, not to nothing (Gunnarsson, Combining tracking and regularization in recursive least squares, 1996),
    so the curve does not run off where a trial does not go. Within a trial the recursion is summed up, with each
    interval's own weight, and the two steps alternate.
    """

    MEMORY_TRIALS = 0.7
    """Trials after which a weight has fallen to 1/e."""
    CURVE_SHARE, CURVE_LENGTH_US = 0.3, 60.0
    """How far the curve may leave the approved one, of its largest torque, and over which widths that is alike."""
    INDEPENDENT = 30.0
    """Variance of an interval's error, of that of the noise: what the model leaves is alike from one to the next."""
    LINEAR_SD = 0.2
    """The same of the logarithms of T and ζ."""
    SWEEPS = 4

    def __init__(self, model: Model, test: Record) -> None:  # noqa: ARG002
        assert isinstance(model.linear, SecondOrder)
        self.model, self.linear = model, model.linear
        basis = model.recruitment.basis
        self.first = self.curve = np.asarray(model.recruitment.coefficients_nm)
        u = np.linspace(0.0, basis.largest_us, 121)
        sd_nm = self.CURVE_SHARE * float(np.max(model.recruitment(u)))
        alike = np.exp(-0.5 * (np.subtract.outer(u, u) / self.CURVE_LENGTH_US) ** 2) + 1e-3 * np.eye(u.size)
        design = basis.design(u)
        self.tied = design.T @ np.linalg.solve(sd_nm**2 * alike, design)
        self.tied_linear = np.eye(2) / self.LINEAR_SD**2
        self.known, self.pull = np.zeros_like(self.tied), np.zeros(self.first.size)
        self.known_linear, self.pull_linear = np.zeros((2, 2)), np.zeros(2)
        self.moved = np.zeros(2)
        self.variance = self.INDEPENDENT * max(model.noise.block_sd_nm, 1e-3) ** 2

    def at(self, moved: np.ndarray) -> SecondOrder:
        """The dynamics with T and ζ moved by these logarithms."""
        start = self.model.linear
        assert isinstance(start, SecondOrder)
        t_s, damping = start.time_constant_s * np.exp(moved[0]), start.damping * np.exp(moved[1])
        return SecondOrder(float(t_s), float(damping), start.delay_s)

    def learn(self, trial: Record) -> dict[str, Any]:
        """The approved model with the curve and the dynamics as they are now."""
        width_us, torque_nm = intervals(trial)
        kept = np.exp(-1.0 / self.MEMORY_TRIALS)
        precise = kept ** (np.arange(torque_nm.size, 0, -1) / torque_nm.size) / self.variance
        design = self.model.recruitment.basis.design(width_us)
        known = known_linear = np.zeros(0)
        pull = pull_linear = np.zeros(0)
        for _ in range(self.SWEEPS):
            seen = driven(self.at(self.moved), design)
            known = kept * self.known + (seen.T * precise) @ seen
            pull = kept * self.pull + (seen.T * precise) @ (torque_nm - seen @ self.first)
            self.curve = np.maximum(self.first + np.linalg.solve(known + self.tied, pull), 0.0)
            drive = design @ self.curve
            expected = driven(self.at(self.moved), drive)
            step = 1e-4
            slope = [(driven(self.at(self.moved + step * row), drive) - expected) / step for row in np.eye(2)]
            slope = np.array(slope).T
            target = torque_nm - expected + slope @ self.moved
            known_linear = kept * self.known_linear + (slope.T * precise) @ slope
            pull_linear = kept * self.pull_linear + (slope.T * precise) @ target
            self.moved = np.clip(np.linalg.solve(known_linear + self.tied_linear, pull_linear), -1.0, 1.0)
        self.known, self.pull, self.known_linear, self.pull_linear = known, pull, known_linear, pull_linear
        curve = Curve(self.model.recruitment.basis, self.curve)
        return self.model.with_(recruitment=curve, linear=self.at(self.moved)).to_dict()


class Refit:
    """The whole model fitted again after each trial, on the pre-session test and all trials so far.

    That was better for it than the last one, two or three trials, with or without the test: a trial alone does not
    reach the upper end of the curve, which a muscle that tires needs next.
    """

    def __init__(self, model: Model, test: Record) -> None:
        self.served, self.records = model.to_dict(), [test]

    def learn(self, trial: Record) -> dict[str, Any]:
        """The new model, or the last one where the records do not determine it."""
        self.records.append(trial)
        with contextlib.suppress(IdentifyError):
            self.served = identify.fit(join(self.records, [None] * len(self.records))).to_dict()
        return self.served


class Bank:
    """A bank of models: gains and thresholds on a grid around the approved one, weighted by likelihood.

    After multiple-model control of stimulated muscle (Brend, Freeman and French). From trial to trial the weights
    spread to the neighbours, which is how the bank forgets. Served is the mean.
    """

    GAINS = np.exp(np.linspace(np.log(0.4), np.log(1.7), 59))
    SHIFTS_US = np.linspace(-40.0, 40.0, 41)
    GAIN_SD, SHIFT_SD_US = 0.06, 3.0
    """Of a change from trial to trial, log and µs."""

    def __init__(self, model: Model, test: Record) -> None:  # noqa: ARG002
        self.model = model
        gain, shift = np.log(self.GAINS), self.SHIFTS_US
        self.weight = np.outer(np.exp(-0.5 * (gain / 0.1) ** 2), np.exp(-0.5 * (shift / 5.0) ** 2))
        self.spread_gain = _kernel(gain, self.GAIN_SD)
        self.spread_shift = _kernel(shift, self.SHIFT_SD_US)

    def learn(self, trial: Record) -> dict[str, Any]:
        """The approved model with the mean gain and shift."""
        width_us, torque_nm = intervals(trial)
        shifted = np.where(width_us > 0, width_us - self.SHIFTS_US[:, None], 0.0)
        linear = self.model.linear
        assert isinstance(linear, SecondOrder)
        expected = driven(linear, self.model.recruitment(np.maximum(shifted, 0.0)).T)  # one column a shift
        across = expected.T @ torque_nm
        squares = torque_nm @ torque_nm - 2 * np.outer(self.GAINS, across)
        squares = squares + np.outer(self.GAINS**2, np.sum(expected**2, axis=0))
        gain, shift = np.unravel_index(np.argmin(squares), squares.shape)
        variance = noise_variance(torque_nm - self.GAINS[gain] * expected[:, shift])
        prior = np.maximum(self.spread_gain @ self.weight @ self.spread_shift.T, 1e-300)
        log = np.log(prior) - 0.5 * (squares - squares.min()) / variance
        self.weight = np.exp(log - log.max())
        self.weight /= self.weight.sum()
        mean = float(np.sum(self.weight.sum(axis=1) * np.log(self.GAINS)))
        values = Values(float(np.exp(mean)), float(self.weight.sum(axis=0) @ self.SHIFTS_US))
        return moved_model(self.model, values).to_dict()


def _kernel(places: np.ndarray, sd: float) -> np.ndarray:
    spread = np.exp(-0.5 * (np.subtract.outer(places, places) / sd) ** 2)
    return spread / spread.sum(axis=0)


UNTRACKED, OURS = "no tracking", "tracking"
FOLLOWERS: dict[str, Callable[[Model, Record], Follower] | None] = {
    UNTRACKED: None,
    OURS: Ours,
    "recursive least squares": Recursive,
    "bank of models": Bank,
    "refit of everything": Refit,
}
