"""The noise of a fit on the grid of pulses: white plus slow, and a narrow band if there is tremor; compiled.

Tremor does not depend on the stimulation, and its frequency and size vary. As part of the noise it needs only three
parameters, and other effects can be compared beside it. It is a stochastic oscillator in an exact Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

MEAN_OF_SLOW = 0.27
"""Largest correlation of neighbouring innovations that the mean over an interval causes."""
SLOWEST_S = 25.0 / 6.0
"""Memory of the slowest noise; anything slower is a drift, which has a cause."""
LEAST_WHITE = 0.25
"""Share of the variance that is white beside a slow part that is held."""
Stretches = tuple[np.ndarray, np.ndarray]
"""Starts and ends of runs of intervals; noise is correlated only within a run."""
LOWEST_HZ, HIGHEST_HZ = 2.8, 14.5


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of the interval means."""

    ar1: float  # correlation of neighbours of the slow part
    share: float
    """Share of the variance that is slow. Above 1: all of it is slow, and smoothed by the mean over an interval."""
    sd_nm: float  # total standard deviation of an interval's mean, N·m
    turn: float = 0.0  # of a narrow band: angle per step, rad
    decay: float = 0.0  # of it: decay factor per step
    band: float = 0.0  # of it: share of the variance; 0: no band
    shortest: float = 0.006  # 1 - ar1 of the slowest noise (`of_steps`); by default at 40 pulses/s
    slowest: float = 0.02  # smallest angle, rad
    fastest: float = 2.6  # largest angle, rad
    held: bool = False
    """Held as it is, whatever the residual looks like; or white of any size, so that all error counts."""

    @property
    def at_bound(self) -> bool:
        """Return true for the slowest noise: anything slower is a drift, and levels cost the likelihood nothing."""
        return not self.held and min(self.share, 1.0) > 0.05 and self.ar1 >= 1.0 - 1.01 * self.shortest

    def of_steps(self, step_s: float) -> NoiseLevel:
        """The same on a grid of such steps, on which the slowest noise has a memory of `SLOWEST_S`."""
        return replace(self, shortest=step_s / SLOWEST_S)

    def band_s(self, step_s: float) -> float:
        """Time in which a wave of the narrow band dies away to 1/e, s."""
        return step_s / max(1.0 - self.decay, 1e-6)

    @property
    def is_white(self) -> bool:
        """Return true if hardly any of it is correlated from one interval to the next."""
        return self.band <= 0.0 and min(self.share, 1.0) * self.ar1 < 0.05

    @property
    def correlation(self) -> float:
        """Correlation of neighbours of the slow part; 0 where hardly any of the noise is slow."""
        return 0.0 if self.is_white else self.ar1


WHITE = NoiseLevel(0.0, 0.0, 1.0, held=True)
"""White noise of any size."""
WHITE_AND_SLOW = NoiseLevel(0.5, 0.5, 1.0)
"""White and slow noise of any size."""
SLOW_STEPS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]]) @ np.eye(2, 5)
SLOW_GUESSES = np.array([[0.3, 0.9], [0.03, 0.3], [0.03, 1.0], [0.5, 0.02], [0.3, 1.7]]) @ np.eye(2, 5)
"""Share that is forgotten in a step, and share of the slow part."""
BAND_STEPS = np.repeat(np.eye(5), 2, axis=0) * np.tile([1.0, -1.0], 5)[:, None]
"""Directions of the searches: log(1 - ar1), slow share of the rest, turn, log(1 - decay), band."""


def profile(
    residual: np.ndarray, stretches: Stretches, near: NoiseLevel, wide: bool = True
) -> tuple[NoiseLevel, float]:
    """The most likely noise of the same kind as `near`, and its log-likelihood; searched over a `wide` range or not."""
    if near.held:
        if near.share == 0.0:
            fitted = np.concatenate([residual[start:stop] for start, stop in zip(*stretches, strict=True)])
            near = replace(near, sd_nm=max(float(np.sqrt(np.mean(fitted**2))), 1e-9))
        white, log_det = _whiten(residual[None, :], *stretches, *_parts(near))
        variance, size = near.sd_nm**2, white.size
        return near, -0.5 * (np.sum(white**2) / variance + size * np.log(2.0 * np.pi * variance)) - log_det
    slow = np.log(1.0 - min(near.ar1, 1.0 - near.shortest))
    if near.band > 0.0:
        share = min(near.share / max(1.0 - near.band, 1e-9), 1.0)
        x = np.array([slow, share, near.turn, np.log(1.0 - min(near.decay, 0.9999)), near.band])
        return _profile_band(residual, stretches, x, 0.15, 0.03, near)
    bounds = np.array([[np.log(near.shortest), 0.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0, 0.0]])
    starts = np.array([[slow, near.share, 0.0, 0.0, 0.0]])
    if wide:
        guesses = SLOW_GUESSES.copy()
        guesses[:, 0] = np.log(guesses[:, 0])
        starts = np.concatenate([starts, guesses])
    step = np.array([0.6, 0.2, 0.0, 0.0, 0.0]) * (1.0 if wide else 0.25)
    x, sd, log_likelihood = _search(residual, *stretches, starts, bounds, step, SLOW_STEPS, 0.01 / step[0], 1e-9)
    ar1, share = float(1.0 - np.exp(x[0])), float(x[1])
    return replace(near, ar1=ar1, share=share, sd_nm=max(float(sd), 1e-9)), log_likelihood


def beside_zero(wander_nm: float, error_nm: float, memory_s: float, step_s: float) -> NoiseLevel:
    """A zero that wanders by some sd, N·m, with some memory, s, and white noise for the rest of an error, N·m."""
    slow = wander_nm**2
    variance = slow + max(error_nm**2 - slow, LEAST_WHITE * error_nm**2)
    return NoiseLevel(float(np.exp(-step_s / memory_s)), slow / variance, float(np.sqrt(variance)), held=True)


def correlation(residual: np.ndarray, stretches: Stretches, step_s: float) -> float:
    """Correlation of neighbours of the slow part of a residual, N·m, shape (K,); 0 where it is white."""
    return profile(residual, stretches, WHITE_AND_SLOW.of_steps(step_s))[0].correlation


def _profile_band(
    residual: np.ndarray, stretches: Stretches, x: np.ndarray, wide: float, smallest_step: float, near: NoiseLevel
) -> tuple[NoiseLevel, float]:
    lower = [np.log(near.shortest), 0.0, near.slowest, np.log(0.0008), 0.001]
    upper = [0.0, 1.0, near.fastest, np.log(20.0 * near.shortest), 0.999]
    bounds = np.array([lower, upper])
    step = wide * np.array([1.5, 0.4, 0.12, 1.5, 0.4])
    x, sd, log_likelihood = _search(residual, *stretches, x[None, :], bounds, step, BAND_STEPS, smallest_step, 1e-7)
    ar1, decay = (float(1.0 - np.exp(log)) for log in (x[0], x[3]))
    share, turn, band = float(x[1] * (1.0 - x[4])), float(x[2]), float(x[4])
    sd_nm = max(float(sd), 1e-9)
    return replace(near, ar1=ar1, share=share, sd_nm=sd_nm, turn=turn, decay=decay, band=band), log_likelihood


def find_band(residual: np.ndarray, stretches: Stretches, step_s: float) -> tuple[NoiseLevel, float]:
    """The most likely noise with a narrow band between 2.8 and 14.5 Hz, and its log-likelihood."""
    turns = (2 * np.pi * LOWEST_HZ * step_s, 2 * np.pi * min(HIGHEST_HZ, 0.42 / step_s) * step_s)
    near = replace(WHITE_AND_SLOW.of_steps(step_s), slowest=turns[0], fastest=turns[1])
    candidates = []
    for frequency_hz in _peaks(residual, stretches, step_s):
        for width_hz in (0.1, 0.7):
            x = np.array([np.log(0.3), 0.5, 2 * np.pi * frequency_hz * step_s, np.log(np.pi * width_hz * step_s), 0.5])
            candidates.append(_profile_band(residual, stretches, x, 1.0, 0.05, near))
    return max(candidates, key=lambda candidate: candidate[1])


def _peaks(residual: np.ndarray, stretches: Stretches, step_s: float) -> list[float]:
    """Two frequencies at which the residual's spectrum is highest above a smooth background."""
    value = np.zeros(residual.size)
    for a, b in zip(*stretches, strict=True):
        value[a:b] = residual[a:b] - np.mean(residual[a:b])
    power = np.abs(np.fft.rfft(value)) ** 2
    power = np.convolve(power, np.ones(7) / 7, "same")
    frequency = np.fft.rfftfreq(value.size, step_s)
    inside = (frequency > LOWEST_HZ) & (frequency < min(HIGHEST_HZ, 0.42 / step_s))
    if not inside.any():
        return [5.0]
    slope = np.polyfit(np.log(frequency[inside]), np.log(power[inside] + 1e-30), 2)
    stand_out = np.where(inside, np.log(power + 1e-30) - np.polyval(slope, np.log(np.maximum(frequency, 1e-9))), -99.0)
    first = int(np.argmax(stand_out))
    stand_out[np.abs(frequency - frequency[first]) < 1.2] = -99.0
    return [float(frequency[first]), float(frequency[int(np.argmax(stand_out))])]


def whitened(rows: np.ndarray, stretches: Stretches, noise: NoiseLevel) -> np.ndarray:
    """Rows on the grid, shape (M, K), whitened to unit variance; the fitted intervals in order, shape (M, F)."""
    if noise.share <= 0.0 and noise.band <= 0.0:
        return np.concatenate([rows[:, a:b] for a, b in zip(*stretches, strict=True)], axis=1) / noise.sd_nm
    return _whiten(rows, *stretches, *_parts(noise))[0] / noise.sd_nm


def band_part(residual: np.ndarray, stretches: Stretches, noise: NoiseLevel) -> np.ndarray:
    """The narrow band's part of a residual; zero in intervals that were not fitted."""
    if noise.band <= 0.0:
        return np.zeros(residual.size)
    return _smooth_band(residual, *stretches, *_parts(noise))


def _parts(noise: NoiseLevel) -> tuple[float, float, float, float, float]:
    return noise.ar1, noise.share, noise.turn, noise.decay, noise.band


# ---- kernels ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _gains(length, ar1, slow, turn, decay, band):  # pragma: no cover
    """What an innovation adds to the next state (slow, cos, sin), (S, 3), its scale, and half its log variance.

    Of an exact Kalman filter of `length` steps from the stationary state, total variance 1; of means of slow noise
    (`slow` above 1) by the innovations algorithm. The last values hold on: the filter has settled after S steps.
    """
    gains, variances, k = np.zeros((length, 3)), np.empty(length), 0
    if band > 0.0:
        k = _band_gains(gains, variances, ar1, slow, turn, decay, band)
    elif slow > 1.0:  # x[k] = ar1 x[k-1] + e[k] + mean e[k-1]
        mean = (slow - 1.0) * MEAN_OF_SLOW
        first = (1.0 + 2.0 * ar1 * mean + mean * mean) / (1.0 - ar1 * ar1)
        r, last = first, 0.0
        while k < length and r != last:
            gains[k, 0], variances[k], last = ar1 + mean / r, r / first, r
            r = 1.0 + mean * mean - mean * mean / r
            k += 1
    else:
        p, last, fresh = slow, -1.0, (1.0 - ar1 * ar1) * slow
        while k < length and not abs(p - last) < 1e-10 * (1e-6 + last):
            s = max(p + 1.0 - slow, 1e-12)
            gains[k, 0], variances[k], last = ar1 * p / s, s, p
            p = ar1 * ar1 * (p - p * p / s) + fresh
            k += 1
    scale, half = np.empty(k), np.empty(k)
    for i in range(k):  # single values: numba compiles a row that is written to a slice for seconds
        scale[i], half[i] = 1.0 / np.sqrt(variances[i]), 0.5 * np.log(variances[i])
    return gains, scale, half


@njit(cache=True, nogil=True)
def _band_gains(gains, variances, ar1, slow, turn, decay, band):  # pragma: no cover
    """Gains and variances as in `_gains`, with an oscillator; the number of steps until they settle."""
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    fresh, new = slow * (1 - ar1 * ar1), band * (1 - decay * decay)
    xx, xu, xv, uu, uv, vv = slow, 0.0, 0.0, band, 0.0, band  # covariance of the state
    for k in range(variances.size):
        x, u, v = xx + xu, xu + uu, xv + uv
        variance = variances[k] = x + u + max(1.0 - slow - band, 1e-9)
        gains[k, 0] = ar1 * x / variance
        gains[k, 1], gains[k, 2] = (c * u - s * v) / variance, (s * u + c * v) / variance
        xx, xu, xv = xx - x * x / variance, xu - x * u / variance, xv - x * v / variance
        uu, uv, vv = uu - u * u / variance, uv - u * v / variance, vv - v * v / variance
        xx, xu, xv = ar1 * ar1 * xx + fresh, ar1 * (c * xu - s * xv), ar1 * (s * xu + c * xv)
        uu, uv, vv = (
            c * c * uu - 2.0 * c * s * uv + s * s * vv + new,
            c * s * (uu - vv) + (c * c - s * s) * uv,
            s * s * uu + 2.0 * c * s * uv + c * c * vv + new,
        )
        if k > 30 and abs(variances[k] - variances[k - 1]) < 1e-11:
            return k + 1
    return variances.size


@njit(cache=True, nogil=True)
def _whiten(rows, start, stop, ar1, slow, turn, decay, band):  # pragma: no cover
    """Innovations of rows, (M, K), scaled to equal variance, (M, F), and half the log determinant of a row."""
    longest, total = 0, 0
    for i in range(start.size):
        longest, total = max(longest, stop[i] - start[i]), total + stop[i] - start[i]
    gains, scale, half = _gains(longest, ar1, slow, turn, decay, band)
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    white, log_det, settled = np.empty((rows.shape[0], total)), 0.0, scale.size
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            x, u, v = 0.0, 0.0, 0.0
            g, by_cos, by_sin, size = gains[0, 0], gains[0, 1], gains[0, 2], scale[0]
            for k in range(stop[i] - start[i]):
                if k < settled:
                    g, by_cos, by_sin, size = gains[k, 0], gains[k, 1], gains[k, 2], scale[k]
                y = rows[m, start[i] + k] - u
                e = y - x
                white[m, f] = e * size
                x = (ar1 - g) * x + g * y  # = ar1 x + g e, with a shorter wait for the last x
                if band > 0.0:
                    u, v = c * u - s * v + by_cos * e, s * u + c * v + by_sin * e
                f += 1
    for i in range(start.size):
        log_det += np.sum(half[: stop[i] - start[i]]) + max(stop[i] - start[i] - settled, 0) * half[-1]
    return white, log_det


@njit(cache=True, nogil=True)
def _cost(row, start, stop, x):  # pragma: no cover
    """Minus the profiled log-likelihood of a residual at x, up to a constant, and the variance."""
    slow, decay = x[1] * (1.0 - x[4]), 1.0 - np.exp(x[3])
    white, log_det = _whiten(row.reshape(1, row.size), start, stop, 1.0 - np.exp(x[0]), slow, x[2], decay, x[4])
    squares = 0.0
    for k in range(white.shape[1]):
        squares += white[0, k] * white[0, k]
    variance = max(squares / max(white.shape[1], 1), 1e-24)
    return 0.5 * white.shape[1] * np.log(variance) + log_det, variance


@njit(cache=True, nogil=True)
def _search(row, start, stop, starts, bounds, step, directions, smallest_step, smallest_gain):  # pragma: no cover
    """Pattern search from the best of some starts, halving its steps; x, sd and log-likelihood."""
    x = np.minimum(np.maximum(starts[0], bounds[0]), bounds[1])
    best, variance = _cost(row, start, stop, x)
    for guess in starts[1:]:
        value, squares = _cost(row, start, stop, guess)
        if value < best:
            best, variance, x = value, squares, guess
    scale = 1.0
    while scale > smallest_step:
        moved = False
        for direction in directions:
            trial = np.minimum(np.maximum(x + scale * step * direction, bounds[0]), bounds[1])
            if np.all(trial == x):
                continue
            value, squares = _cost(row, start, stop, trial)
            if value < best - smallest_gain:
                best, variance, x, moved = value, squares, trial, True
        if not moved:
            scale *= 0.5
    total = np.sum(stop - start)
    return x, np.sqrt(variance), -best - 0.5 * total * (np.log(2 * np.pi) + 1.0)


@njit(cache=True, nogil=True)
def _smooth_band(row, start, stop, ar1, slow, turn, decay, band):  # pragma: no cover
    """The oscillator's part of a residual y, given all of it: its covariance times the inverse one of y times y."""
    white, _ = _whiten(row.reshape(1, row.size), start, stop, ar1, slow, turn, decay, band)
    gains, scale, _ = _gains(white.shape[1], ar1, slow, turn, decay, band)
    c, s, last = decay * np.cos(turn), decay * np.sin(turn), white.shape[1]
    out = np.zeros(row.size)
    for i in range(start.size - 1, -1, -1):
        length = stop[i] - start[i]
        last -= length
        weights = np.empty(length)
        x, u, v, ahead, turned = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(length - 1, -1, -1):  # the adjoint of the filter gives the inverse covariance times y
            j = min(k, scale.size - 1)
            weights[k] = white[0, last + k] * scale[j] - gains[j, 0] * x - gains[j, 1] * u - gains[j, 2] * v
            x, u, v = ar1 * x + weights[k], c * u + s * v + weights[k], c * v - s * u
            out[start[i] + k] = band * ahead
            ahead, turned = c * (ahead + weights[k]) - s * turned, s * (ahead + weights[k]) + c * turned
        ahead, turned = 0.0, 0.0
        for k in range(length):
            ahead, turned = c * ahead - s * turned + weights[k], s * ahead + c * turned
            out[start[i] + k] += band * ahead
    return out
