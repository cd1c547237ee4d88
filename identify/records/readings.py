"""Independent readings behind the samples of a record: recorders hold, round, interpolate, smooth and clip.

The white noise of a sample is estimated from differences of neighbours. Most differences of held or interpolated
samples are zero, those of smoothed ones nearly so: there the noise is that of the readings behind them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

REPEATED = 0.2
"""Share of the changes that come after a repeated value, from which values are held or coarse."""
COUNTS = 2.5
"""If small changes have at most this many counts, a repeated value is due to rounding."""
ROUNDING = 1e-12
STRAIGHT = 0.02
"""A second difference below this share of a large one is none."""
BENDS = 0.4
"""Share of the bends that come after a straight line, from which values are interpolated; noise gives 0.03."""
CALM_S = 1.0
"""So long after the pulse width changed a muscle moves little."""
CHANGED = 0.05
"""Change of the pulse width, as a share of the largest, that the torque follows."""
RISE, FLAT = 2.0, 1.3
"""Differences of every other sample that are larger by `RISE` show smoothing (white noise gives 1, the slowest noise of
first order 1.4); where wider ones are larger by less than `FLAT`, they are of readings apart."""
LEAST_DIFFERENCES = 64
"""Fewer differences give no estimate."""
BLOCK = 32
WIDEST = 256
"""Samples between those that are compared, at most."""
LEAST_EQUAL = 20
"""Number of samples at exactly the largest (or smallest) value from which they count as clipping."""
REPEATS = 4
"""The largest value counts as clipping if it repeats so many times as often as those near it."""


@dataclass(frozen=True)
class Readings:
    """The readings behind the samples of a record that has fewer readings than samples, or coarse ones."""

    kind: str  # "held", "counts" (coarse), "interpolated" or "smoothed"
    at: np.ndarray  # samples that are readings of their own, rising
    samples_each: float  # samples for each reading, at least 1
    count_nm: float = 0.0  # one count of a coarse converter, N·m; else 0
    held_s: float = 0.0  # how long a reading is held, s; 0 where none is, or where that is not known

    @property
    def words(self) -> str:
        """A sentence for people."""
        apart = f"{self.samples_each:.3g}"
        if self.kind == "counts":
            return f"The converter's counts of {self.count_nm:.2g} N·m are as coarse as the noise, which includes them."
        if self.kind == "held":
            return f"The recorder holds each reading for {apart} samples: the noise is that of the readings."
        if self.kind == "interpolated":
            return f"Samples lie on lines between readings {apart} samples apart: the noise is that of the readings."
        return f"The torque was smoothed: the noise is that of samples {apart} apart at rest, and no more than that."


def find_readings(torque_nm: np.ndarray) -> Readings | None:
    """The readings of a torque as it was recorded; None where each sample is one, and fine."""
    step = np.diff(torque_nm)
    # At its lowest and highest value a sensor may clip.
    inside = (torque_nm > torque_nm.min()) & (torque_nm < torque_nm.max())
    same = (step == 0.0) & inside[1:]
    changes = np.flatnonzero(step) + 1
    if changes.size < BLOCK:
        return None
    if np.mean(same[changes[1:] - 2]) > REPEATED:
        return _held_or_coarse(torque_nm.size, changes, np.abs(step[changes - 1]))
    bend = np.abs(np.diff(step))
    real = bend > ROUNDING * float(np.max(np.abs(torque_nm)))
    straight = ~real | (bend <= STRAIGHT * np.quantile(bend[real], 0.9)) if real.any() else ~real
    bends = np.flatnonzero(~straight)
    if bends.size < LEAST_DIFFERENCES or np.mean(straight[bends[1:] - 1]) < BENDS:
        return None
    # A bend between two samples shows at both: the larger one is nearer.
    follows = np.diff(bends) == 1
    less = np.r_[bend[bends[:-1]] < bend[bends[1:]], False] & np.r_[follows, False]
    less |= np.r_[False, bend[bends[1:]] <= bend[bends[:-1]]] & np.r_[False, follows]
    at = bends[~less] + 1
    return Readings("interpolated", at, torque_nm.size / at.size)


def _held_or_coarse(size: int, changes: np.ndarray, step_nm: np.ndarray) -> Readings:
    count_nm = float(step_nm.min())
    if np.quantile(step_nm, 0.25) > COUNTS * count_nm:
        return Readings("held", np.r_[0, changes], size / (changes.size + 1.0))
    # Two coarse readings may be equal: each lasts as long as the shortest, but for a few.
    lasts = max(int(np.quantile(np.diff(changes), 0.02, method="lower")), 1)
    edges = np.r_[0, changes, size]
    number = np.maximum(np.round(np.diff(edges) / lasts).astype(np.int64), 1)
    first = np.repeat(edges[:-1], number)
    at = first + lasts * (np.arange(first.size) - np.repeat(np.cumsum(number) - number, number))
    return Readings("counts", at[at < size], float(lasts), count_nm)


def smoothed_readings(torque_nm: np.ndarray, rests: np.ndarray) -> Readings | None:
    """Readings apart of a torque whose noise was smoothed; None if it was not, or if that cannot be decided.

    `torque_nm`: shape (N,); torque without mains hum, N·m. `rests`: shape (N,); samples at which the muscle rests.
    """
    spreads_nm, apart = [], 1
    while 3 * apart < torque_nm.size and apart <= WIDEST:
        y, end = torque_nm, torque_nm.size
        size = y[3 * apart :] - 3.0 * (y[2 * apart : end - apart] - y[apart : end - 2 * apart]) - y[: end - 3 * apart]
        size = size[rests[3 * apart :] & rests[: end - 3 * apart]]
        if size.size < LEAST_DIFFERENCES:
            break
        spreads_nm.append(float(np.median(np.abs(size))))
        if len(spreads_nm) == 2 and not spreads_nm[1] > RISE * spreads_nm[0]:
            break
        if len(spreads_nm) > 2 and spreads_nm[-1] < FLAT * spreads_nm[-2]:
            return Readings("smoothed", np.arange(0, end, apart), float(apart))
        apart *= 2
    return None


def contrasts(at: np.ndarray, values: np.ndarray, order: int) -> np.ndarray:
    """Divided differences of values at uneven places, scaled so that white noise keeps its standard deviation."""
    size = at.size - order
    places = [at[k : k + size].astype(float) for k in range(order + 1)]
    total, power = np.zeros(size), np.zeros(size)
    for k, place in enumerate(places):
        weight = np.ones(size)
        for other in (*places[:k], *places[k + 1 :]):
            weight /= place - other
        total += weight * values[k : k + size]
        power += weight**2
    return total / np.sqrt(power)


def calm_samples(width_us: np.ndarray, rate_hz: float, rest: bool = False) -> np.ndarray:
    """bool, shape (N,): samples at which the pulse width has long been the same, or (`rest`) 0."""
    changed = np.abs(np.diff(width_us, prepend=np.inf)) > CHANGED * float(width_us.max())
    if rest:
        changed |= width_us > 0.0
    last = np.maximum.accumulate(np.where(changed, np.arange(width_us.size), 0))
    return np.arange(width_us.size) - last > CALM_S * rate_hz


def noise_of_readings(torque_nm: np.ndarray, calm: np.ndarray, readings: Readings, order: int) -> float:
    """White noise of a reading, N·m, where the muscle moves little if that is long enough; else an upper bound.

    Rounding to counts is part of it: no reading is known better than to 1/√12 of a count.
    """
    at = readings.at
    if at.size <= order:
        return float(np.std(torque_nm))
    size = contrasts(at, torque_nm[at], order)
    quiet = calm[at[order:]] & calm[at[:-order]]
    size = size[quiet] if quiet.sum() >= LEAST_DIFFERENCES else size
    if not readings.count_nm:
        return float(np.sqrt(np.median(size**2) / 0.4549))
    # The median of whole counts jumps: means of blocks do not.
    blocks = np.array_split(size, max(size.size // BLOCK, 1))
    power = float(np.median([np.mean(block**2) for block in blocks]))
    return float(np.sqrt(max(power, readings.count_nm**2 / 12.0)))


def flat_top(torque: np.ndarray) -> float | None:
    """Return the largest value if the sensor clips there, else None.

    Where the converter's step hides the noise, a muscle that holds its torque (or rests) comes to its largest value by
    single steps and stays there, as it stays elsewhere, too: that is not clipping.
    """
    top = float(torque.max())
    changes = np.flatnonzero(np.diff(torque)) + 1
    if not changes.size:
        return None
    # Of equal values in a row, but for the first, which nothing leads to.
    lasts, values = np.diff(np.r_[changes, torque.size]), torque[changes]
    step_nm = np.abs(values - torque[changes - 1])
    flat = values == top
    equal = int(lasts[flat].sum())
    if equal < LEAST_EQUAL:
        return None
    # With coarse quantisation every value repeats: a ceiling must repeat far more often than the values below it.
    near = torque[(torque > top - 0.25 * (top - float(np.median(torque)))) & (torque < top)]
    # A quiet record that rests at its largest value is not clipped.
    if not near.size or equal < REPEATS * np.max(np.unique(near, return_counts=True)[1]):
        return None
    by_one = flat & (step_nm < 1.5 * step_nm.min())
    hidden = np.max(lasts[~flat], initial=0) >= LEAST_EQUAL
    return None if hidden and 2 * lasts[by_one].sum() > equal else top
