"""What the samples show before means are taken: hum, clipping and white noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identify.effects.mains_hum import line
from identify.estimation.hum import find_hum, hum_variation
from identify.records.record import Record

LEAST_EQUAL = 20
"""Number of samples at exactly the largest (or smallest) value from which they count as clipping."""


@dataclass(frozen=True)
class Raw:
    """What the samples of a record show.

    Parameters
    ----------
    torque_nm : ndarray, shape (N,)
        Torque without mains hum, N·m.
    noise_sd_nm : float
        White noise of a sample, N·m.
    hum : dict or None
        Parameters of the effect `mains_hum`; None if there is no hum.
    ceiling_nm, floor_nm : float or None
        Levels at which the sensor clips, N·m; None if it does not.
    """

    torque_nm: np.ndarray
    noise_sd_nm: float
    hum: dict[str, float] | None
    ceiling_nm: float | None
    floor_nm: float | None


def inspect(record: Record, start_s: float | None = None) -> Raw:
    """Find hum, clipping and white noise in a record, without its held-out and doubted rows.

    The phase of the hum refers to `start_s`, by default the time of the first sample.
    """
    own_s = record.time_s - (record.time_s[0] if start_s is None else start_s)
    kept = ~record.held_out if record.doubted is None else ~record.held_out & ~record.doubted
    torque = record.torque_nm
    ceiling, floor = _flat(torque[kept]), _flat(-torque[kept])
    hum = find_hum(record, own_s, kept)
    if hum is not None:
        torque = torque - line(hum, own_s)
        torque = torque - hum_variation(record, torque, hum["frequency_hz"], kept)
    noise = white_noise(record, torque[kept])
    return Raw(torque, noise, hum, ceiling, None if floor is None else -floor)


def _flat(torque: np.ndarray) -> float | None:
    """The largest value, if it occurs far too often for a noisy signal; else None."""
    top = float(torque.max())
    equal = int(np.sum(torque == top))
    if equal < LEAST_EQUAL or top == float(torque.min()):
        return None
    # With coarse quantisation every value repeats: a ceiling must repeat far more often than the values below it.
    values, counts = np.unique(torque[torque > top - 0.25 * (top - float(np.median(torque)))], return_counts=True)
    below = counts[values < top]
    # A quiet record that rests at its largest value is not clipped.
    if below.size == 0 or equal < 4 * np.max(below):
        return None
    return top


def white_noise(record: Record, torque: np.ndarray) -> float:
    """Robust estimate of the white noise of a sample from third (or fourth) differences, N·m.

    At low sampling rates the torque changes from sample to sample; the estimate is then an upper bound.
    """
    if torque.size < 16:
        return float(np.std(torque))
    order = 3 if record.sample_rate_hz > 3.0 * record.pulse_rate_hz else 4
    difference = np.diff(torque, order)
    gain = {3: 20.0, 4: 70.0}[order]
    return float(np.sqrt(np.median(difference**2) / 0.4549 / gain))
