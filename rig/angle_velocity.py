"""Velocity of a joint out of its angles: at once for a page, and centred for a recording.

At once: slope of a line through the last 50 ms, so it is 25 ms late. Centred: slope of a parabola through 60 ms around
each sample (Savitzky and Golay), so it is not late; at the ends of a stretch the parabola is one-sided.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

LIVE_WINDOW_S = 0.05
LEAST = 3
"""Samples for a slope at once."""
WINDOW_S = 0.06
METHOD = "local quadratic over 60 ms, centred"
LONGEST_GAP_S = 0.05
"""Over a shorter gap the angle is interpolated. A longer one ends a stretch."""


class LiveSlope:
    """Slopes of the newest samples, by nothing that comes after them."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._width = max(LEAST - 1, round(LIVE_WINDOW_S * rate_hz))
        self.forget()

    def forget(self) -> None:
        """Begin again, without the samples until now."""
        self._number, self._value = np.empty(0, np.int64), np.empty(0)

    def add(self, number: Numbers, value: Array) -> Array:
        """Slope per second at each of these samples, shape (n,); NaN where too few came before it.

        Parameters
        ----------
        number
            Of the samples, rising, shape (n,); gaps may be in it.
        value
            Shape (n,).
        """
        numbers, values = np.concatenate([self._number, number]), np.concatenate([self._value, value])
        behind = number[:, None] - numbers[None, :]
        inside = (behind >= 0) & (behind <= self._width)
        count = inside.sum(axis=1)
        x = -behind / self._rate_hz
        x = np.where(inside, x - ((x * inside).sum(axis=1) / count)[:, None], 0.0)
        spread = (x * x).sum(axis=1)
        rise = (x * np.where(inside, values[None, :], 0.0)).sum(axis=1)
        kept = numbers >= numbers[-1] - self._width
        self._number, self._value = numbers[kept], values[kept]
        return np.divide(rise, spread, out=np.full(len(number), np.nan), where=count >= LEAST)


def centred(angle_rad: Array, number: Numbers, rate_hz: float) -> Array:
    """Velocity at each sample, rad/s, shape (n,).

    Parameters
    ----------
    angle_rad
        Finite, shape (n,).
    number
        Of the samples, rising, shape (n,).
    rate_hz
        Samples per second.
    """
    if not len(number):
        return np.empty(0)
    ends = np.flatnonzero(np.diff(number) > max(1.0, LONGEST_GAP_S * rate_hz)) + 1
    found = np.zeros(len(number))
    for part in np.split(np.arange(len(number)), ends):
        at = number[part] - number[part[0]]
        even_rad = np.interp(np.arange(at[-1] + 1), at, angle_rad[part])
        found[part] = _slopes(even_rad, max(1, round(0.5 * WINDOW_S * rate_hz)))[at] * rate_hz
    return found


def _slopes(value: Array, half: int) -> Array:
    """Slope per sample at each one of an even stretch, by a parabola through `half` neighbours on either side."""
    width = 2 * half + 1
    if len(value) < width:
        return _of_parabola(value, np.arange(len(value)))
    x = np.arange(-half, half + 1)
    middle = np.convolve(value, -x / np.sum(x * x), "valid")  # a parabola's slope in its centre is that of a line
    before, after = np.arange(half), np.arange(half + 1, width)
    return np.concatenate([_of_parabola(value[:width], before), middle, _of_parabola(value[-width:], after)])


def _of_parabola(value: Array, at: Numbers) -> Array:
    """Slope per sample of the parabola through these values, at some of them."""
    if len(value) < 2:
        return np.zeros(len(at))
    centre = 0.5 * (len(value) - 1)
    fitted = np.polynomial.polynomial.polyfit(np.arange(len(value)) - centre, value, min(2, len(value) - 1))
    return np.asarray(
        np.polynomial.polynomial.polyval(at - centre, np.polynomial.polynomial.polyder(fitted)), np.float64
    )
