"""Aligns the load cell's clock with the test's clock, and estimates the standard error.

The sync line is the best source: the cell saw each pulse begin, and the host knows when it wrote each pulse. Without
one, the cell's counter is fitted to the lower envelope of the host's receive times: a sample can come late, never
early. This fit cannot see the shortest delay of the transport itself, which stays in the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Method = Literal["sync", "regression", "cell", "stamps", "order"]

MIN_EDGES = 8
MEDIAN_EFFICIENCY = 1.2533
"""Standard error of a median over that of a mean, for normal errors (sqrt(pi / 2))."""
MAX_POINTS = 400
MISFIT_WINDOWS = 8
COARSE_MISFIT_S = 0.005
RATE_TOLERANCE = 0.035
"""Largest deviation of a device's rate from the rig file's; a larger one ends the test."""
BELIEVED_RATES = 0.25, 4.0
"""No two clocks differ by more. A rate outside means that a backlog was read at once: the rate is unknown."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Method by which the times were obtained."""

    method: Method  # of a load cell: sync or regression; of an angle sensor: see `stimrig.rig.align_angle`
    error_ms: float
    """Standard error of the offset, ms; NaN if there were too few samples to estimate it. Of an angle sensor it
    contains that of the torque, through which it was obtained."""
    delay_ms: float  # median time from a sample's aligned time to its arrival at the host, ms
    rate_ppm: float  # how much slower (+) the cell's clock runs than the host's


@dataclass(frozen=True, slots=True)
class Line:
    """The test's clock as a line over the cell's; the offset holds at `centre_s`, `error_s` is its standard error."""

    offset_s: float
    rate: float
    centre_s: float
    error_s: float

    def at(self, cell_s: Array) -> Array:
        return self.offset_s + self.centre_s + self.rate * (cell_s - self.centre_s)


def cell_time(counter: NDArray[np.int64], stamp_s: Array, sample_rate_hz: float) -> Array:
    """Time on the cell's own clock, s: by its counter, else the transport's stamps, else by counting samples."""
    if len(counter) and np.all(counter >= 0):
        return counter / sample_rate_hz
    if len(stamp_s) and np.all(np.isfinite(stamp_s)):
        return stamp_s - stamp_s[0]
    return np.arange(len(counter)) / sample_rate_hz


def counted_rate_hz(samples: NDArray[Any]) -> float:
    """Samples per second of these two or more, by their counter, else by counting them; times are the host's."""
    first, last = samples[0], samples[-1]
    counted = int(last["counter"] - first["counter"]) if first["counter"] >= 0 else len(samples) - 1
    return round(counted / max(float(last["host_time_s"] - first["host_time_s"]), 1e-9), 3)


def describe(method: Method, error_s: float, host_s: Array, time_s: Array, rate: float) -> Alignment:
    """Return how `time_s` was obtained for samples that arrived at `host_s`, shape (N,) both."""
    return Alignment(method, error_s * 1e3, float(np.median(host_s - time_s)) * 1e3, (rate - 1) * 1e6)


def align(
    cell_s: Array, host_s: Array, sync: NDArray[np.uint8], written_s: Array, sample_rate_hz: float
) -> tuple[Array, Alignment]:
    """Aligned time of each torque sample, shape (N,), on the test's clock, and how it was obtained.

    `cell_s`, `host_s`, `sync`: time on the cell's clock (s), receive time on the test's clock (s) and sync line (255:
    none), shape (N,). `written_s`: when the pulses were written, s on the test's clock, shape (M,), rising, no NaN.
    `sample_rate_hz`: nominal; a sync edge lies half a sample, on average, before the sample that shows it.
    """
    if len(cell_s) < 2:
        return host_s.copy(), Alignment("regression", float("nan"), 0.0, 0.0)
    points = earliest(cell_s, host_s)
    envelope = line_below(*points)
    pairs = paired(rising_edges(cell_s, sync, sample_rate_hz), written_s, envelope)
    if pairs is None or len(pairs[0]) < MIN_EDGES:
        error_s = float(np.hypot(envelope.error_s, misfit(envelope, *points)))
        time_s = envelope.at(cell_s)
        return time_s, describe("regression", error_s, host_s, time_s, envelope.rate)
    *seen, reliable = pairs
    line = robust_line(*seen)
    misfit_s, coarse_s = misfit(line, *seen), 0.0 if reliable else misfit(envelope, *points)
    if coarse_s > COARSE_MISFIT_S:  # then edges may have been matched to the wrong pulses
        misfit_s = max(misfit_s, coarse_s)
    # Pulses are often synchronous with the samples, so a pulse's position in its sample does not average out.
    error_s = float(np.hypot(np.hypot(line.error_s, 1 / sample_rate_hz / np.sqrt(12)), misfit_s))
    time_s = line.at(cell_s)
    return time_s, describe("sync", error_s, host_s, time_s, line.rate)


def robust_line(cell_s: Array, host_s: Array) -> Line:
    """host ≈ offset + rate × cell through points of which up to a quarter may be far off."""
    centre_s = float(np.mean(cell_s))
    lead_s = host_s - cell_s
    chosen = np.unique(np.linspace(0, len(cell_s) - 1, min(len(cell_s), MAX_POINTS)).round().astype(int))
    slope, known = 0.0, False
    if np.ptp(cell_s[chosen]) > 0 and len(chosen) >= 3:
        slope = _median_slope(cell_s[chosen], lead_s[chosen])
        known = BELIEVED_RATES[0] <= 1 + slope <= BELIEVED_RATES[1]
        slope = slope if known else 0.0
    residual_s = lead_s - slope * (cell_s - centre_s)
    offset_s = (
        float(np.median(residual_s)) if known else float(np.min(residual_s))
    )  # no sample arrives before it is taken
    spread_s = 1.4826 * float(np.median(np.abs(residual_s - offset_s)))
    error_s = MEDIAN_EFFICIENCY * spread_s / np.sqrt(len(cell_s)) if known else np.nan
    return Line(offset_s, 1 + slope, centre_s, float(error_s))


def _median_slope(x: Array, y: Array) -> float:
    """Theil and Sen's slope: the median over all pairs (scipy.stats has it, but takes 0.4 s to import)."""
    i, j = np.triu_indices(len(x), 1)
    apart = x[j] != x[i]
    return float(np.median((y[j] - y[i])[apart] / (x[j] - x[i])[apart]))


def misfit(line: Line, cell_s: Array, host_s: Array) -> float:
    """Largest slow deviation from the line (a clock with a drifting rate), s: the worst of the windows' medians.

    The scatter that medians of so few points have by chance is subtracted.
    """
    residual_s = host_s - line.at(cell_s)
    parts = np.array_split(residual_s, int(np.clip(len(residual_s) // 5, 1, MISFIT_WINDOWS)))
    if len(parts) < 3:
        return 0.0
    worst_s = max(abs(float(np.median(part))) for part in parts)
    scatter_s = 1.4826 * float(np.median([np.median(np.abs(part - np.median(part))) for part in parts]))
    by_chance_s = 3.0 * MEDIAN_EFFICIENCY * scatter_s / np.sqrt(min(len(part) for part in parts))
    return max(0.0, worst_s - by_chance_s)


def line_below(cell_s: Array, host_s: Array) -> Line:
    """A line through the earliest samples of windows, without those windows in which all came late."""
    line = robust_line(cell_s, host_s)
    if np.min(host_s - line.at(cell_s)) < -COARSE_MISFIT_S:  # before it was taken: too many windows came late
        lead_s = host_s - cell_s
        apart_s = np.abs(cell_s[:, None] - cell_s)
        later_s = lead_s[:, None] - lead_s - RATE_TOLERANCE * apart_s  # than another window allows
        prompt = np.max(later_s, axis=1) <= COARSE_MISFIT_S
        line = robust_line(cell_s[prompt], host_s[prompt])
    return line


def earliest(cell_s: Array, host_s: Array) -> tuple[Array, Array]:
    """The sample of each of many windows that came with the shortest delay: its times on both clocks."""
    windows = int(np.clip((cell_s[-1] - cell_s[0]) / 0.5, 1, MAX_POINTS))
    lead_s = host_s - cell_s
    edges = np.searchsorted(cell_s, np.linspace(cell_s[0], cell_s[-1], windows + 1)[1:-1])
    parts = [part for part in np.split(np.arange(len(cell_s)), edges) if len(part)]
    first = np.array([part[np.argmin(lead_s[part])] for part in parts])
    return cell_s[first], host_s[first]


def rising_edges(cell_s: Array, sync: NDArray[np.uint8], sample_rate_hz: float) -> Array:
    """When the sync line rose, s on the cell's clock: half a sample before the sample that shows it."""
    period_s = 1 / sample_rate_hz
    rising = (sync[1:] == 1) & (sync[:-1] == 0) & (np.diff(cell_s) < 1.5 * period_s)
    return cell_s[1:][rising] - period_s / 2


def paired(edge_s: Array, written_s: Array, envelope: Line) -> tuple[Array, Array, bool] | None:
    """Pairs (cell's time of a pulse, host's time of writing it), and whether the match is reliable; None: no sync."""
    if len(written_s) < MIN_EDGES or len(edge_s) == 0:
        return None
    if len(edge_s) == len(written_s) and _in_step(edge_s, written_s):
        return edge_s, written_s, True
    about_s = envelope.at(edge_s)
    after = np.clip(np.searchsorted(written_s, about_s), 1, len(written_s) - 1)
    nearest = np.where(about_s - written_s[after - 1] < written_s[after] - about_s, after - 1, after)
    within_s = 0.45 * float(np.min(np.diff(written_s)))
    near = np.abs(written_s[nearest] - about_s) < within_s
    return edge_s[near], written_s[nearest[near]], False


def _in_step(edge_s: Array, written_s: Array) -> bool:
    """Return whether there are as many edges as pulses, at the same intervals: then they match in this order.

    A stall of the host bends the envelope, and the nearest pulse may then be the wrong one.
    """
    lead_s = written_s - robust_line(edge_s, written_s).at(edge_s)
    return float(np.quantile(np.abs(lead_s), 0.9)) < 0.25 * float(np.min(np.diff(written_s)))
