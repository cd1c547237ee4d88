"""The noise of a fit on the grid of pulses: white plus slow, and a narrow band if there is tremor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stimrig.identify.noise.kernels import (
    MEAN_OF_SLOW,
    SHORTEST,
    profile_band,
    profile_noise,
    smooth_band,
    whiten_band,
    whiten_rows,
)

Stretches = tuple[np.ndarray, np.ndarray]

LOWEST_HZ, HIGHEST_HZ = 2.8, 14.5


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of the interval means.

    Parameters
    ----------
    ar1 : float
        Correlation of neighbours of the slow part.
    share : float
        Share of the variance that is slow. Above 1: all of it is slow, and smoothed by the mean over an interval.
    sd_nm : float
        Total standard deviation of an interval's mean, N·m.
    turn, keep, band : float
        Of a narrow band: angle per step, rad, decay factor per step, and share of the variance (0: no band).
    slowest, fastest : float
        Bounds of the angle, rad.
    """

    ar1: float
    share: float
    sd_nm: float
    turn: float = 0.0
    keep: float = 0.0
    band: float = 0.0
    slowest: float = 0.02
    fastest: float = 2.6

    @property
    def is_white(self) -> bool:
        """Whether hardly any of it is correlated from one interval to the next."""
        return self.band <= 0.0 and min(self.share, 1.0) * self.ar1 < 0.05


def profile(
    residual: np.ndarray, stretches: Stretches, near: NoiseLevel, wide: bool = True
) -> tuple[NoiseLevel, float]:
    """The most likely noise of the same kind as `near`, and its log-likelihood; searched over a `wide` range or not."""
    start, stop = stretches
    if near.band <= 0.0:
        ar1, share, sd, log_likelihood = profile_noise(residual, start, stop, near.ar1, near.share, wide)
        return NoiseLevel(ar1, share, max(sd, 1e-9)), log_likelihood
    x = np.array(
        [
            np.log(1.0 - min(near.ar1, 1.0 - SHORTEST)),
            min(near.share / max(1.0 - near.band, 1e-9), 1.0),
            near.turn,
            np.log(1.0 - min(near.keep, 0.9999)),
            near.band,
        ]
    )
    return _search(residual, stretches, x, 0.15, 0.03, (near.slowest, near.fastest))


def _search(
    residual: np.ndarray, stretches: Stretches, x: np.ndarray, wide: float, least: float, turns: tuple[float, float]
) -> tuple[NoiseLevel, float]:
    start, stop = stretches
    lower = np.array([np.log(SHORTEST), 0.0, turns[0], np.log(0.0008), 0.001])
    upper = np.array([0.0, 1.0, turns[1], np.log(0.12), 0.999])
    x, sd, log_likelihood = profile_band(
        residual,
        start,
        stop,
        np.clip(x, lower, upper),
        lower,
        upper,
        wide * np.array([1.5, 0.4, 0.12, 1.5, 0.4]),
        least,
    )
    noise = NoiseLevel(
        ar1=float(1.0 - np.exp(x[0])),
        share=float(x[1] * (1.0 - x[4])),
        sd_nm=max(float(sd), 1e-9),
        turn=float(x[2]),
        keep=float(1.0 - np.exp(x[3])),
        band=float(x[4]),
        slowest=turns[0],
        fastest=turns[1],
    )
    return noise, log_likelihood


def find_band(residual: np.ndarray, stretches: Stretches, step_s: float) -> tuple[NoiseLevel, float]:
    """The most likely noise with a narrow band between 2.8 and 14.5 Hz, and its log-likelihood."""
    best: tuple[NoiseLevel, float] | None = None
    turns = (2 * np.pi * LOWEST_HZ * step_s, 2 * np.pi * min(HIGHEST_HZ, 0.42 / step_s) * step_s)
    for frequency_hz in _peaks(residual, stretches, step_s):
        for width_hz in (0.1, 0.7):
            x = np.array([np.log(0.3), 0.5, 2 * np.pi * frequency_hz * step_s, np.log(np.pi * width_hz * step_s), 0.5])
            found = _search(residual, stretches, x, 1.0, 0.05, turns)
            if best is None or found[1] > best[1]:
                best = found
    assert best is not None
    return best


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
    """Rows, shape (M, K), whitened to unit variance; the fitted intervals in order."""
    start, stop = stretches
    if noise.band <= 0.0:
        return whiten_rows(rows, start, stop, noise.ar1, noise.share)[0] / noise.sd_nm
    white, _ = whiten_band(rows, start, stop, noise.ar1, noise.share, noise.turn, noise.keep, noise.band)
    return white / noise.sd_nm


def band_part(residual: np.ndarray, stretches: Stretches, noise: NoiseLevel) -> np.ndarray:
    """The narrow band's part of a residual; zero in intervals that were not fitted."""
    if noise.band <= 0.0:
        return np.zeros(residual.size)
    start, stop = stretches
    return smooth_band(residual, start, stop, noise.ar1, noise.share, noise.turn, noise.keep, noise.band)


POINTS = 1 << 14
"""Number of frequencies of a spectrum: a band with a memory of 1000 steps covers ten of them."""
NUDGE = 1e-4
LEAST_SHARE = 1e-9


def correlation_slopes(noise: NoiseLevel, lags: int) -> np.ndarray:
    """Derivatives of the innovations' correlations at lags 1 to `lags` by the estimated parameters of the noise.

    A parameter at its bound, or without influence, has no row.

    Returns
    -------
    ndarray, shape (numbers, lags)
        From the derivative of the log spectrum by each parameter: the spectrum that a wrong value leaves.
    """
    slow = noise.share > LEAST_SHARE and noise.ar1 > LEAST_SHARE
    names = []
    if slow:
        names += ["share"] if noise.share < 2.0 else []
        names += ["ar1"] if noise.ar1 < 1.0 - SHORTEST - LEAST_SHARE else []
    if noise.band > 0.0:
        names += ["band", "turn", "keep"]
    rows = []
    for name in names:
        # Towards smaller values: away from the bounds, and from the kink of `share` at 1.
        nudge = -NUDGE * max(1.0 - getattr(noise, name), NUDGE) if name in ("ar1", "keep") else -NUDGE
        moved = replace(noise, **{name: max(getattr(noise, name) + nudge, 0.0)})
        change = (_log_spectrum(moved) - _log_spectrum(noise)) / nudge
        rows.append(np.fft.irfft(change)[1 : lags + 1])
    return np.array(rows).reshape(len(rows), lags)


def _log_spectrum(noise: NoiseLevel) -> np.ndarray:
    """Log of the noise's spectrum from frequency 0 to half the pulse rate, up to a constant."""
    # A narrow band is 100 times narrower than the spectrum of the slowest noise.
    angle = np.linspace(0.0, np.pi, (POINTS if noise.band > 0.0 else POINTS // 4) // 2 + 1)
    if noise.band <= 0.0 and noise.share > 1.0:
        mean = (noise.share - 1.0) * MEAN_OF_SLOW
        return np.log(1.0 + mean * mean + 2.0 * mean * np.cos(angle)) + np.log(_pole(angle, noise.ar1))
    white = max(1.0 - noise.share - noise.band, 1e-9)
    power = white + noise.share * _pole(angle, noise.ar1)
    if noise.band > 0.0:
        band = _pole(angle - noise.turn, noise.keep) + _pole(angle + noise.turn, noise.keep)
        power = power + 0.5 * noise.band * band
    return np.log(power)


def _pole(angle: np.ndarray, keep: float) -> np.ndarray:
    """Spectrum of noise of variance 1 whose correlation falls by the factor `keep` per step."""
    return (1.0 - keep * keep) / (1.0 + keep * keep - 2.0 * keep * np.cos(angle))
