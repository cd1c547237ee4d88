"""Signals of several clocks and rates at the times of one: held, interpolated, and pulses on their even slots."""

from __future__ import annotations

import numpy as np

from stimrig.api.exchange.inward.foreign import Signal, Spans
from stimrig.identify.records import bounds
from stimrig.identify.records.pulse_times import (
    LEAST_LATE_S,
    RESTS,
    SENT_AND_ACKNOWLEDGED,
    Sent,
    in_force,
    locate_pulses,
)


def pulses_in_force(
    time_s: np.ndarray, width_us: np.ndarray, rate_hz: float, at_s: np.ndarray
) -> dict[str, np.ndarray] | None:
    """Width in force at each time of pulses at times of their own, and `late_s` where one was off its even slot.

    None where two fall on one slot.
    """
    slot = np.round((time_s - time_s[0]) * rate_hz).astype(np.int64)
    if slot[-1] > bounds.LARGEST_ROWS or (np.diff(slot) < 1).any():
        return None
    planned_s = time_s[0] + np.arange(slot[-1] + 2) / rate_hz  # a rest behind the last
    widths, written = np.zeros(planned_s.size), np.full(planned_s.size, np.nan)
    widths[slot], written[slot] = width_us, time_s
    status = np.where(np.isnan(written), RESTS, SENT_AND_ACKNOWLEDGED)
    sent = Sent(planned_s, widths, written, written, status, 1 / rate_hz)
    pulses, _ = locate_pulses(sent, at_s, np.full(at_s.size, 255.0))
    in_force_us, late_s = in_force(pulses, at_s, rate_hz)
    return {"pulse_width_us": in_force_us, **({"late_s": late_s} if late_s.any() else {})}


def pulse_rate(time_s: np.ndarray) -> float:
    """Pulses a second by their times, rests left out; a whole number where that is as good over the whole record."""
    slot = np.r_[0, np.cumsum(np.round(np.diff(time_s) / np.median(np.diff(time_s))))]
    from_zero = time_s - time_s[0]
    rate_hz = 1 / float(np.polyfit(slot, from_zero, 1)[0])
    drift_s = abs(rate_hz - round(rate_hz)) / rate_hz * float(from_zero[-1])
    return float(round(rate_hz)) if drift_s < LEAST_LATE_S and round(rate_hz) else rate_hz


def same(one: Signal, other: Signal) -> bool:
    return one.time_s is other.time_s or np.array_equal(one.time_s, other.time_s)


def held(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """The last value before each time; 0 before the first."""
    if not time_s.size:
        return np.zeros(at_s.size)
    last = np.searchsorted(time_s, at_s + 1e-9, side="right") - 1
    return np.where(last >= 0, values[np.maximum(last, 0)], 0.0)


def between(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray, elsewhere: float | None) -> np.ndarray:
    """Values on a straight line between their times; outside as given, None: as at the nearest."""
    good = np.isfinite(values) & np.isfinite(time_s)
    if not good.any():
        return np.full(at_s.size, np.nan)
    return np.interp(at_s, time_s[good], values[good], elsewhere, elsewhere)


def coded(spans: Spans, time_s: np.ndarray) -> tuple[list[str], np.ndarray]:
    names = list(dict.fromkeys(name for name, _, _ in spans.rows))
    code = np.full(time_s.size, -1)
    for name, start_s, end_s in spans.rows:
        code[(time_s >= start_s) & (time_s < end_s + 1e-9)] = names.index(name)  # as of a sealed recording
    return names, code
