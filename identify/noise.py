"""The noise of a fit on the grid of pulses: white plus slow, and a narrow band if there is tremor; compiled.

Tremor does not depend on the stimulation, and its frequency and size vary. As part of the noise it needs only three
parameters, and other effects can be compared beside it. It is a stochastic oscillator in an exact Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

MEAN_OF_SLOW = 0.27
"""Largest correlation of neighbouring innovations that the mean over an interval causes."""
SHORTEST = 0.006
"""1 - ar1 of the slowest noise (a memory of 4 s at 40 pulses/s); anything slower is a drift, which has a cause."""
Stretches = tuple[np.ndarray, np.ndarray]

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
    slowest: float = 0.02  # smallest angle, rad
    fastest: float = 2.6  # largest angle, rad
    white_only: bool = False
    """White whatever the residual looks like, so that all error of a wrong structure counts."""

    @property
    def at_bound(self) -> bool:
        """Return true for the slowest noise: anything slower is a drift, and levels cost the likelihood nothing."""
        return min(self.share, 1.0) > 0.05 and self.ar1 >= 1.0 - 1.01 * SHORTEST

    @property
    def is_white(self) -> bool:
        """Return true if hardly any of it is correlated from one interval to the next."""
        return self.band <= 0.0 and min(self.share, 1.0) * self.ar1 < 0.05

    @property
    def correlation(self) -> float:
        """Correlation of neighbours of the slow part; 0 where hardly any of the noise is slow."""
        return 0.0 if self.is_white else self.ar1


WHITE = NoiseLevel(0.0, 0.0, 1.0, white_only=True)
"""White noise of any size."""


def profile(
    residual: np.ndarray, stretches: Stretches, near: NoiseLevel, wide: bool = True
) -> tuple[NoiseLevel, float]:
    """The most likely noise of the same kind as `near`, and its log-likelihood; searched over a `wide` range or not."""
    if near.white_only:
        fitted = np.concatenate([residual[start:stop] for start, stop in zip(*stretches, strict=True)])
        sd = max(float(np.sqrt(np.mean(fitted**2))), 1e-9)
        return replace(near, sd_nm=sd), -0.5 * fitted.size * (np.log(2 * np.pi * sd * sd) + 1.0)
    if near.band <= 0.0:
        ar1, share, sd, log_likelihood = profile_noise(residual, *stretches, near.ar1, near.share, wide)
        return NoiseLevel(ar1, share, max(sd, 1e-9)), log_likelihood
    slow, fading = np.log(1.0 - min(near.ar1, 1.0 - SHORTEST)), np.log(1.0 - min(near.decay, 0.9999))
    share = min(near.share / max(1.0 - near.band, 1e-9), 1.0)
    x = np.array([slow, share, near.turn, fading, near.band])
    return _search(residual, stretches, x, 0.15, 0.03, (near.slowest, near.fastest))


def correlation(residual: np.ndarray, stretches: Stretches) -> float:
    """Correlation of neighbours of the slow part of a residual, N·m, shape (K,); 0 where it is white."""
    return profile(residual, stretches, NoiseLevel(0.0, 0.5, 1.0))[0].correlation


def _search(
    residual: np.ndarray,
    stretches: Stretches,
    x: np.ndarray,
    wide: float,
    smallest_step: float,
    turns: tuple[float, float],
) -> tuple[NoiseLevel, float]:
    lower = np.array([np.log(SHORTEST), 0.0, turns[0], np.log(0.0008), 0.001])
    upper = np.array([0.0, 1.0, turns[1], np.log(0.12), 0.999])
    step = wide * np.array([1.5, 0.4, 0.12, 1.5, 0.4])
    x = np.clip(x, lower, upper)
    x, sd, log_likelihood = _profile_band(residual, *stretches, x, lower, upper, step, smallest_step)
    noise = NoiseLevel(
        ar1=float(1.0 - np.exp(x[0])),
        share=float(x[1] * (1.0 - x[4])),
        sd_nm=max(float(sd), 1e-9),
        turn=float(x[2]),
        decay=float(1.0 - np.exp(x[3])),
        band=float(x[4]),
        slowest=turns[0],
        fastest=turns[1],
    )
    return noise, log_likelihood


def find_band(residual: np.ndarray, stretches: Stretches, step_s: float) -> tuple[NoiseLevel, float]:
    """The most likely noise with a narrow band between 2.8 and 14.5 Hz, and its log-likelihood."""
    turns = (2 * np.pi * LOWEST_HZ * step_s, 2 * np.pi * min(HIGHEST_HZ, 0.42 / step_s) * step_s)
    candidates = []
    for frequency_hz in _peaks(residual, stretches, step_s):
        for width_hz in (0.1, 0.7):
            x = np.array([np.log(0.3), 0.5, 2 * np.pi * frequency_hz * step_s, np.log(np.pi * width_hz * step_s), 0.5])
            candidates.append(_search(residual, stretches, x, 1.0, 0.05, turns))
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
    if noise.band <= 0.0:
        return _whiten_rows(rows, *stretches, noise.ar1, noise.share) / noise.sd_nm
    white, _ = _whiten_band(rows, *stretches, noise.ar1, noise.share, noise.turn, noise.decay, noise.band)
    return white / noise.sd_nm


def band_part(residual: np.ndarray, stretches: Stretches, noise: NoiseLevel) -> np.ndarray:
    """The narrow band's part of a residual; zero in intervals that were not fitted."""
    if noise.band <= 0.0:
        return np.zeros(residual.size)
    return _smooth_band(residual, *stretches, noise.ar1, noise.share, noise.turn, noise.decay, noise.band)


# ---- kernels: white plus slow, then with a band -------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _ratio(ar1, mean):  # pragma: no cover
    """Variance of means of slow noise, divided by that of their innovations."""
    return (1.0 + 2.0 * ar1 * mean + mean * mean) / (1.0 - ar1 * ar1)


@njit(cache=True, nogil=True)
def _whiten_means(rows, start, stop, ar1, mean, total):  # pragma: no cover
    """Innovations of means of slow noise, x[k] = ar1 x[k-1] + e[k] + mean e[k-1], by the innovations algorithm."""
    white = np.empty((rows.shape[0], total))
    first = _ratio(ar1, mean)
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            r, x = first, 0.0
            for k in range(start[i], stop[i]):
                e = rows[m, k] - x
                white[m, f] = e * np.sqrt(first / r)
                x = ar1 * rows[m, k] + mean * e / r
                r = 1.0 + mean * mean - mean * mean / r
                f += 1
    return white


@njit(cache=True, nogil=True)
def _whiten_rows(rows, start, stop, ar1, share):  # pragma: no cover
    """Innovations of white plus AR(1) noise, scaled to equal variance, by an exact Kalman filter."""
    total = np.sum(stop - start)
    if share > 1.0:
        return _whiten_means(rows, start, stop, ar1, (share - 1.0) * MEAN_OF_SLOW, total)
    white, gain, scale = np.empty((rows.shape[0], total)), np.empty(total), np.empty(total)
    f = 0
    noise = (1.0 - ar1 * ar1) * share
    for i in range(start.size):
        p = share
        for _ in range(stop[i] - start[i]):
            s = max(p + 1.0 - share, 1e-12)
            gain[f] = p / s
            scale[f] = 1.0 / np.sqrt(s)
            p = ar1 * ar1 * (p - p * p / s) + noise
            f += 1
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            x = 0.0
            for k in range(start[i], stop[i]):
                e = rows[m, k] - x
                white[m, f] = e * scale[f]
                x = ar1 * (x + gain[f] * e)
                f += 1
    return white


@njit(cache=True, nogil=True)
def _squares(row, start, stop, ar1, share):  # pragma: no cover
    """Sum of squared innovations, half the log determinant, count. The filter's gain converges within some steps."""
    total, squares, logdet = 0, 0.0, 0.0
    if share > 1.0:
        mean = (share - 1.0) * MEAN_OF_SLOW
        first = _ratio(ar1, mean)
        for i in range(start.size):
            r, x = first, 0.0
            for k in range(start[i], stop[i]):
                e = row[k] - x
                squares += e * e * first / r
                if r != 1.0:
                    logdet += 0.5 * np.log(r / first)
                else:
                    logdet -= 0.5 * np.log(first)
                x = ar1 * row[k] + mean * e / r
                r = 1.0 + mean * mean - mean * mean / r
                total += 1
        return squares, logdet, total
    noise = (1.0 - ar1 * ar1) * share
    for i in range(start.size):
        p, x, k, end = share, 0.0, start[i], stop[i]
        total += end - k
        s = 1.0
        while k < end:
            s = max(p + 1.0 - share, 1e-12)
            e = row[k] - x
            squares += e * e / s
            logdet += 0.5 * np.log(s)
            x = ar1 * (x + p / s * e)
            fresh = ar1 * ar1 * (p - p * p / s) + noise
            k += 1
            if abs(fresh - p) < 1e-10 * (1e-6 + p):
                break
            p = fresh
        if k < end:
            gain, sum_e = p / s, 0.0
            logdet += 0.5 * (end - k) * np.log(s)
            for j in range(k, end):
                e = row[j] - x
                sum_e += e * e
                x = ar1 * (x + gain * e)
            squares += sum_e / s
    return squares, logdet, total


@njit(cache=True, nogil=True)
def _minus_log_likelihood(row, start, stop, ar1, share):  # pragma: no cover
    """Minus the profiled log-likelihood of one residual, up to a constant, and its variance."""
    squares, logdet, total = _squares(row, start, stop, ar1, share)
    variance = max(squares / max(total, 1), 1e-24)
    return 0.5 * total * np.log(variance) + logdet, variance


STEPS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Directions of the pattern search in log(1 - ar1) and share."""


@njit(cache=True, nogil=True)
def profile_noise(row, start, stop, ar1, share, wide):  # pragma: no cover
    """The most likely correlation and slow share of a residual, by a pattern search from the given start.

    ar1, share, sd and log_likelihood; `sd` is the total standard deviation, slow and white together.
    """
    total = np.sum(stop - start)
    # a = log(1 - ar1), from log(SHORTEST) (long memory) to 0 (none).
    low, high = np.log(SHORTEST), 0.0
    a, b = min(max(np.log(1.0 - min(ar1, 1.0 - SHORTEST)), low), high), min(max(share, 0.0), 2.0)
    best, variance = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(a), b)
    for forgotten, guess_b in ((0.3, 0.9), (0.03, 0.3), (0.03, 1.0), (0.5, 0.02), (0.3, 1.7)):
        if not wide:
            break
        guess_a = np.log(forgotten)
        value, squares = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(guess_a), guess_b)
        if value < best:
            best, a, b, variance = value, guess_a, guess_b, squares
    da, db = (0.6, 0.2) if wide else (0.15, 0.05)
    while da > 0.01:
        moved = False
        for to_a, to_b in STEPS:
            na, nb = min(max(a + da * to_a, low), high), min(max(b + db * to_b, 0.0), 2.0)
            if na == a and nb == b:
                continue
            value, squares = _minus_log_likelihood(row, start, stop, 1.0 - np.exp(na), nb)
            if value < best - 1e-9:
                best, a, b, variance, moved = value, na, nb, squares, True
        if not moved:
            da, db = 0.5 * da, 0.5 * db
    return 1.0 - np.exp(a), b, np.sqrt(variance), -best - 0.5 * total * (np.log(2 * np.pi) + 1.0)


@njit(cache=True, nogil=True)
def _system(ar1, slow, turn, decay, band):  # pragma: no cover
    """Transition of (slow, cos, sin) over a step, the stationary covariance, and what each step adds to it."""
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    f = np.array(((ar1, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)))
    fresh = band * (1 - decay * decay)
    return f, np.diag(np.array((slow, band, band))), np.array((slow * (1 - ar1 * ar1), fresh, fresh))


@njit(cache=True, nogil=True)
def _predict(f, p, gain, h, q):  # pragma: no cover
    """Covariance a step later, after a measurement, whose covariance with the state is h; p is used up."""
    fresh = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            p[i, j] -= gain[i] * h[j]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += f[i, a] * p[a, b] * f[j, b]
            fresh[i, j] = total
        fresh[i, i] += q[i]
    return fresh


@njit(cache=True, nogil=True)
def _gains(length, ar1, slow, turn, decay, band):  # pragma: no cover
    """Kalman gains of (slow, cos, sin) and innovation variances for a stretch of `length` from the stationary state."""
    f, p, q = _system(ar1, slow, turn, decay, band)
    white = max(1.0 - slow - band, 1e-9)
    gains, variances, h = np.empty((length, 3)), np.empty(length), np.empty(3)
    for k in range(length):
        for i in range(3):
            h[i] = p[i, 0] + p[i, 1]
        variances[k] = h[0] + h[1] + white
        for i in range(3):
            gains[k, i] = h[i] / variances[k]
        p = _predict(f, p, gains[k], h, q)
        if k > 30 and abs(variances[k] - variances[k - 1]) < 1e-11:  # settled
            gains[k + 1 :], variances[k + 1 :] = gains[k], variances[k]
            break
    return gains, variances


@njit(cache=True, nogil=True)
def _whiten_band(rows, start, stop, ar1, slow, turn, decay, band):  # pragma: no cover
    """As `_whiten_rows`, with an oscillator: `turn`, its angle per step, `decay` per step, and `band`, its share."""
    gains, variances = _gains(np.max(stop - start), ar1, slow, turn, decay, band)
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    white = np.empty((rows.shape[0], np.sum(stop - start)))
    logdet = 0.0
    for i in range(start.size):
        for k in range(stop[i] - start[i]):
            logdet += 0.5 * np.log(variances[k])
    for m in range(rows.shape[0]):
        f = 0
        for i in range(start.size):
            x, u, v = 0.0, 0.0, 0.0
            for k in range(stop[i] - start[i]):
                e = rows[m, start[i] + k] - x - u
                white[m, f] = e / np.sqrt(variances[k])
                x += gains[k, 0] * e
                u += gains[k, 1] * e
                v += gains[k, 2] * e
                x, u, v = ar1 * x, c * u - s * v, s * u + c * v
                f += 1
    return white, logdet


@njit(cache=True, nogil=True)
def _band_cost(row, start, stop, x):  # pragma: no cover
    """Minus the profiled log-likelihood, up to a constant, the variance, and the count.

    At x = (log(1 - ar1), slow share of the rest, turn, log(1 - decay), band).
    """
    slow = x[1] * (1.0 - x[4])
    white, logdet = _whiten_band(row, start, stop, 1.0 - np.exp(x[0]), slow, x[2], 1.0 - np.exp(x[3]), x[4])
    squares = 0.0
    for k in range(white.shape[1]):
        squares += white[0, k] * white[0, k]
    size = white.shape[1]
    variance = max(squares / size, 1e-24)
    return 0.5 * size * np.log(variance) + logdet, variance, size


@njit(cache=True, nogil=True)
def _profile_band(row, start, stop, x, lower, upper, step, smallest_step):  # pragma: no cover
    """Coordinate search from x, halving its steps to `least`; returns x, sd and log-likelihood."""
    rows = row.reshape(1, row.size)
    best, variance, total = _band_cost(rows, start, stop, x)
    scale = 1.0
    while scale > smallest_step:
        moved = False
        for i in range(x.size):
            for sign in (1.0, -1.0):
                trial = x.copy()
                trial[i] = min(max(x[i] + sign * scale * step[i], lower[i]), upper[i])
                if trial[i] == x[i]:
                    continue
                value, squares, _ = _band_cost(rows, start, stop, trial)
                if value < best - 1e-7:
                    best, variance, moved = value, squares, True
                    x = trial
                    break
        if not moved:
            scale *= 0.5
    return x, np.sqrt(variance), -best - 0.5 * total * (np.log(2 * np.pi) + 1.0)


@njit(cache=True, nogil=True)
def _smooth_band(row, start, stop, ar1, slow, turn, decay, band):  # pragma: no cover
    """The oscillator's part of a residual, given all of it (fixed-interval smoother); zero outside the stretches."""
    out = np.zeros(row.size)
    for i in range(start.size):
        f, p, q = _system(ar1, slow, turn, decay, band)
        c, s = f[1, 1], f[2, 1]
        length = stop[i] - start[i]
        gains, variances = _gains(length, ar1, slow, turn, decay, band)
        errors, waves, covariances = np.empty(length), np.empty(length), np.empty((length, 3, 3))
        x, u, v = 0.0, 0.0, 0.0
        for k in range(length):
            errors[k], waves[k], covariances[k] = row[start[i] + k] - x - u, u, p
            x, u, v = x + gains[k, 0] * errors[k], u + gains[k, 1] * errors[k], v + gains[k, 2] * errors[k]
            x, u, v = ar1 * x, c * u - s * v, s * u + c * v
            p = _predict(f, p, gains[k], p[0] + p[1], q)
        # Backward pass on the adjoint r: x_hat = x + P r, with P h = gain * variance; only the oscillator is wanted.
        r = np.zeros(3)
        for k in range(length - 1, -1, -1):
            r[0], r[1], r[2] = ar1 * r[0], c * r[1] + s * r[2], c * r[2] - s * r[1]
            h = errors[k] / variances[k] - (gains[k, 0] * r[0] + gains[k, 1] * r[1] + gains[k, 2] * r[2])
            r[0], r[1] = r[0] + h, r[1] + h
            cov = covariances[k, 1]
            out[start[i] + k] = waves[k] + cov[0] * r[0] + cov[1] * r[1] + cov[2] * r[2]
    return out
