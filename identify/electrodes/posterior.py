"""What is believed of every choice after what has been seen: anatomies that fit, and what they leave over.

Rows of the anatomy's `z` are moved from prior to posterior by likelihood tempering with resampling and random-walk
steps (Del Moral, Doucet and Jasra 2006). What no anatomy explains is a Gaussian process over choices (Rasmussen and
Williams 2006, chapter 2), as is comfort. All is computed anew from what was seen, so that only that need be kept, and
its order does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from stimrig.identify.electrodes.anatomy import OWN, SESSION, Fields, Reach, fields

ROWS = 600
MOVES = 3
"""Steps of each row at each temperature."""
LENGTH_MM = 22.0
"""Over which what is left over, and comfort, change."""
CARRIED = 0.7
"""Correlation of what is left over between two sessions of one person."""
ALONE = 0.1
"""Share of it that belongs to one choice alone (contact, gel)."""
FLOOR, MISFIT, DRIVE, NOISE = 0.02, 0.06, 0.22, 0.2
"""What is left over: in parts of the gain, of the torque there, and of its slope; and what changes from repeat to
repeat, in parts of all that."""
REPORTED = np.array([[0.85, 0.14, 0.01], [0.17, 0.76, 0.07], [0.01, 0.09, 0.90]])
"""Probability of a report (column) where a spill-over is (row)."""
COMFORT_SD = {"level": 1.5, "pair": 0.7, "session": 0.6, "field": 0.8, "report": 0.6}
COMFORT_MEAN, COMFORT_PAIR = 6.5, 0.5


@dataclass(frozen=True)
class Evidence:
    """One session's observations: choices and what they gave, (observations,) each; torque in the search's unit."""

    reach: Reach
    torque: np.ndarray
    spill: np.ndarray
    comfort: np.ndarray


@dataclass(frozen=True)
class Draws:
    """Draws from the posterior of each quantity at each choice, (draws, choices)."""

    torque: np.ndarray
    spill: np.ndarray
    comfort: np.ndarray


def likeness(one: Reach, other: Reach) -> np.ndarray:
    """Correlation of what is left over between choices of two sessions, without noise."""
    far = np.sum((one.where_mm[:, None] - other.where_mm[None]) ** 2, axis=2)
    near = np.exp(-0.5 * far / LENGTH_MM**2)
    smooth = np.mean([near[np.ix_(one.ends[:, a], other.ends[:, b])] for a in (0, 1) for b in (0, 1)], axis=0)
    gap = np.sum([far[np.ix_(one.ends[:, a], other.ends[:, a])] for a in (0, 1)], axis=0)
    kept = 1.0 if one.session == other.session else CARRIED
    return kept * ((1.0 - ALONE) * smooth + ALONE * (gap < 1.0))


def _blocks(left: list[Reach], right: list[Reach]) -> np.ndarray:
    return np.block([[likeness(one, other) for other in right] for one in left])


class Believed:
    """The posterior, given sessions of evidence (today's first) and the choices to speak of."""

    def __init__(self, evidence: list[Evidence], today: Reach, radius_mm: float, seed: int) -> None:
        self.evidence, self.today, self.radius_mm = [each for each in evidence if each.torque.size], today, radius_mm
        self.random = np.random.default_rng(seed)
        self.reaches = [each.reach for each in self.evidence]
        sessions = max((reach.session for reach in self.reaches), default=0)
        self.z = self.random.standard_normal((ROWS, OWN + len(SESSION) * sessions))
        if self.evidence:
            alike = _blocks(self.reaches, self.reaches)
            self.root = cholesky(alike + NOISE**2 * np.eye(len(alike)), lower=True)
            self._temper()

    def _means(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Torque, scale of what is left over, and log likelihood of the spill-over."""
        torque, scale, log = [], [], np.zeros(len(z))
        for each in self.evidence:
            said = fields(z, each.reach, self.radius_mm)
            torque.append(said.torque)
            scale.append(_scale(said))
            log = log + np.log(np.einsum("srk,sk->rk", _kinds(said), REPORTED[:, each.spill.astype(int)])).sum(axis=1)
        return np.hstack(torque), np.hstack(scale), log

    def _log_likelihood(self, z: np.ndarray) -> np.ndarray:
        torque, scale, log = self._means(z)
        seen = np.concatenate([each.torque for each in self.evidence])
        white = solve_triangular(self.root, ((seen - torque) / scale).T, lower=True)
        return log - 0.5 * np.sum(white**2, axis=0) - np.log(scale).sum(axis=1)

    def _temper(self) -> None:
        heat, log = 0.0, self._log_likelihood(self.z)
        while heat < 1.0:
            step = self._step(log, 1.0 - heat)
            heat += step
            weight = np.exp(step * (log - log.max()))
            places = (np.arange(ROWS) + self.random.random()) / ROWS
            kept = np.minimum(np.searchsorted(np.cumsum(weight / weight.sum()), places), ROWS - 1)
            self.z, log = self.z[kept], log[kept]
            root = np.linalg.cholesky(np.cov(self.z.T) + 1e-6 * np.eye(self.z.shape[1]))
            for move in range(MOVES + 2 * (heat >= 1.0)):
                log = self._move(log, heat, root, (1.0, 0.5, 0.25)[move % 3])

    @staticmethod
    def _step(log: np.ndarray, left: float) -> float:
        """The largest step in temperature that keeps half of the rows at work."""
        low, high = 0.0, left
        for _ in range(20):
            weight = np.exp(high * (log - log.max()))
            if np.sum(weight) ** 2 >= 0.5 * len(log) * np.sum(weight**2):
                if high == left:
                    return left
                low = high
            else:
                left, high = high, high
            high = 0.5 * (low + left)
        return max(low, 1e-6)

    def _move(self, log: np.ndarray, heat: float, root: np.ndarray, size: float) -> np.ndarray:
        reach = size * 2.0 / np.sqrt(self.z.shape[1])
        tried = self.z + reach * self.random.standard_normal(self.z.shape) @ root.T
        new = self._log_likelihood(tried)
        gained = heat * (new - log) - 0.5 * (np.sum(tried**2, axis=1) - np.sum(self.z**2, axis=1))
        taken = np.log(self.random.random(ROWS)) < gained
        self.z = np.where(taken[:, None], tried, self.z)
        return np.where(taken, new, log)

    def draws(self) -> Draws:
        """One draw of each quantity at each choice for each row; what is drawn of a choice is without report noise."""
        said = fields(self.z, self.today, self.radius_mm)
        scale = _scale(said)
        left = self._left_over(said.torque.shape)
        return Draws(said.torque + scale * left, self._spill(_kinds(said)), self._comfort())

    def _left_over(self, shape: tuple[int, ...]) -> np.ndarray:
        prior, mean = likeness(self.today, self.today), 0.0
        if self.evidence:
            across = solve_triangular(self.root, _blocks(self.reaches, [self.today]), lower=True)
            prior = prior - across.T @ across
            torque, scale, _ = self._means(self.z)
            seen = np.concatenate([each.torque for each in self.evidence])
            mean = solve_triangular(self.root, ((seen - torque) / scale).T, lower=True).T @ across
        return mean + self._normal(prior, shape)

    def _normal(self, covariance: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        value, vector = np.linalg.eigh(covariance)
        return self.random.standard_normal(shape) @ (vector * np.sqrt(np.maximum(value, 0.0))).T

    def _spill(self, chance: np.ndarray) -> np.ndarray:
        """Kinds of spill-over; today's reports count at their choice."""
        for each in self.evidence:
            if each.reach.session == 0:
                for ends, spill in zip(each.reach.ends, each.spill, strict=True):
                    at = np.flatnonzero((self.today.ends == ends).all(axis=1))
                    chance[:, :, at] *= REPORTED[:, int(spill), None, None]
        chance = np.cumsum(chance, axis=0)
        picked = self.random.random(chance.shape[1:]) * chance[-1]
        return (picked > chance[0]).astype(int) + (picked > chance[1])

    def _comfort(self) -> np.ndarray:
        sd = COMFORT_SD
        mean = COMFORT_MEAN + COMFORT_PAIR * _is_pair(self.today)

        def covariance(one: Reach, other: Reach) -> np.ndarray:
            pairs = np.outer(_is_pair(one), _is_pair(other))
            same = sd["session"] ** 2 * (one.session == other.session)
            return sd["level"] ** 2 + sd["pair"] ** 2 * pairs + same + sd["field"] ** 2 * likeness(one, other)

        left = covariance(self.today, self.today)
        if self.evidence:
            inner = np.block([[covariance(one, other) for other in self.reaches] for one in self.reaches])
            across = np.vstack([covariance(one, self.today) for one in self.reaches])
            seen = np.concatenate(
                [each.comfort - COMFORT_MEAN - COMFORT_PAIR * _is_pair(each.reach) for each in self.evidence]
            )
            root = cholesky(inner + sd["report"] ** 2 * np.eye(len(inner)), lower=True)
            mean = mean + cho_solve((root, True), across).T @ seen
            across = solve_triangular(root, across, lower=True)
            left = left - across.T @ across
        return np.clip(mean + self._normal(left, (ROWS, len(mean))), 0.0, 10.0)


def _is_pair(reach: Reach) -> np.ndarray:
    return (reach.ends[:, 0] != reach.ends[:, 1]).astype(float)


def _scale(said: Fields) -> np.ndarray:
    """Standard deviation of what is left over."""
    return FLOOR * said.gain + MISFIT * np.abs(said.torque) + DRIVE * said.slope


def _kinds(said: Fields) -> np.ndarray:
    """Probability of no, slight and strong spill-over, (3, rows, choices)."""
    return np.clip(np.stack([1.0 - said.slight, said.slight - said.strong, said.strong]), 1e-9, 1.0)
