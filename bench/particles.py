"""A stand-in for NIST's `optbayesexpt`, which was not to be had from the package index where this was written.

It does what that package does (Granade et al. 2012; McMichael and Blakley 2022): a cloud of weighted parameters,
updated by Bayes' rule after each measurement, resampled by the rule of Liu and West with its default a = 0.98, and the
next setting chosen by the variance of the prediction over the cloud against the noise. The model is what a user would
write down: the paper's sigmoid, second-order dynamics and a delay, six parameters. A setting is a level, held for half
a second. Unlike the package, a measurement that is too sharp for the cloud is taken in parts (tempering).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.dynamics.states import step_matrix

COUNT, KEEP, SCALE = 3000, 0.98, 0.5
LEVELS, HOLD = 13, 20


@njit(cache=True, nogil=True)
def simulate(cloud, widths, step_s):  # pragma: no cover
    """Means of the intervals for each row of (gain, log width, middle, log T, log ζ, delay), shape (S, K)."""
    out = np.empty((cloud.shape[0], widths.size))
    for s in range(cloud.shape[0]):
        gain, width, middle = cloud[s, 0], np.exp(cloud[s, 1]), cloud[s, 2]
        a, b, c, d = step_matrix(np.exp(cloud[s, 3]), np.exp(cloud[s, 4]), step_s)
        first = 1.0 / (1.0 + np.exp(middle / width))
        y, v = 0.0, 0.0
        for k in range(widths.size):
            w = gain * (1.0 / (1.0 + np.exp(-(widths[k] - middle) / width)) - first)
            before, rate = y, v
            y, v = w + a * (y - w) + b * v, c * (y - w) + d * v
            out[s, k] = 0.5 * (before + y) + step_s / 12.0 * (rate - v) - cloud[s, 5] * (y - before) / step_s
    return out


class Particles:
    """The cloud of one patient."""

    def __init__(self, top_us: float, largest_nm: float, noise_nm: float, seed: int) -> None:
        self.rng, self.top_us, self.noise_nm = np.random.default_rng(seed), top_us, noise_nm
        self.cloud = np.c_[
            self.rng.uniform(0.0, 2.0 * largest_nm, COUNT),
            self.rng.uniform(np.log(top_us / 150), np.log(top_us / 5), COUNT),
            self.rng.uniform(0.1 * top_us, 0.9 * top_us, COUNT),
            self.rng.uniform(np.log(0.05), np.log(1.0), COUNT),
            self.rng.uniform(np.log(0.4), np.log(2.0), COUNT),
            self.rng.uniform(-0.0025, 0.0025, COUNT),
        ]
        self.weight = np.full(COUNT, 1.0 / COUNT)

    def learn(self, widths: np.ndarray, torque_nm: np.ndarray, new: int) -> None:
        """Bayes' rule for the last `new` intervals, a few at a time, and resampling when few particles are left."""
        for first in range(widths.size - new, widths.size, 2):
            rows, left = slice(first, min(first + 2, widths.size)), 1.0
            while left > 0.0:
                mean = simulate(self.cloud, widths[: rows.stop], 0.025)[:, rows]
                log = -0.5 * np.sum(((torque_nm[rows] - mean) / self.noise_nm) ** 2, axis=1)
                part = self._part(log, left)
                weight = self.weight * np.exp(part * (log - log.max()))
                self.weight = weight / weight.sum()
                left -= part
                if 1.0 / np.sum(self.weight**2) < SCALE * COUNT:
                    self._resample()

    def _part(self, log: np.ndarray, left: float) -> float:
        """The power of a likelihood that the cloud survives: the first measurements are far sharper than the prior."""
        part = left
        while part > 1e-6:
            weight = self.weight * np.exp(part * (log - log.max()))
            if np.sum(weight) ** 2 > 0.3 * COUNT * np.sum(weight**2):
                break
            part *= 0.5
        return part

    def _resample(self) -> None:
        centre = self.weight @ self.cloud
        away = self.cloud - centre
        covariance = (self.weight[:, None] * away).T @ away + 1e-14 * np.eye(6)
        picked = self.cloud[self.rng.choice(COUNT, COUNT, p=self.weight)]
        jitter = self.rng.multivariate_normal(np.zeros(6), (1.0 - KEEP**2) * covariance, COUNT)
        self.cloud = KEEP * picked + (1.0 - KEEP) * centre + jitter
        self.weight = np.full(COUNT, 1.0 / COUNT)

    def next_level(self, widths: np.ndarray) -> float:
        """The level with the largest utility: the log of predicted variance against noise."""
        some = self.cloud[self.rng.choice(COUNT, 200, p=self.weight)]
        best, chosen = -np.inf, 0.0
        for level in np.linspace(0.0, self.top_us, LEVELS):
            tried = simulate(some, np.r_[widths, np.full(HOLD, level)], 0.025)[:, -HOLD:]
            gain = float(np.sum(np.log1p(tried.var(axis=0) / self.noise_nm**2)))
            if gain > best:
                best, chosen = gain, float(level)
        return chosen

    def drawn(self, count: int = 400) -> np.ndarray:
        """Rows drawn from the cloud."""
        return self.cloud[self.rng.choice(COUNT, count, p=self.weight)]
