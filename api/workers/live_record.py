"""The record of a test that still plays, from its live samples: they are not aligned with the pulses yet."""

from __future__ import annotations

from typing import Any

import numpy as np

EARLIEST = 0.02
"""Share of the samples that arrive earliest: what comes later waited somewhere."""
BINS = 5
"""Means for each pulse interval, where a load cell gives at least twice as many samples: the delay of a sample's way to
the host, some milliseconds that only a sealed recording corrects, is then within the one sample that the fit allows."""


def record_of(
    host_time_s: list[float],
    counter: list[int],
    torque_nm: list[float | None],
    laid_us: list[float],
    late: list[tuple[int, float]],
    segments: list[tuple[str, int, int]],
    rate_hz: float,
) -> Any:
    """The record of what was measured since the first pulse, for `decide`; None where there is nothing yet."""
    from stimrig.identify.records.record import Pulses, Record

    if len(host_time_s) < 2:
        return None
    time_s, torque = sample_times(host_time_s, counter), np.array(torque_nm, float)
    inside = np.isfinite(torque) & (time_s >= 0) & (time_s < len(laid_us) / rate_hz - 1e-9)
    if not inside.any():
        return None
    time_s, torque = means(time_s[inside], torque[inside], BINS * rate_hz)
    slot = np.floor(time_s * rate_hz + 1e-9).astype(int)
    widths = np.asarray(laid_us, float)
    starts = np.array([start for _, start, _ in segments])
    code = np.searchsorted(starts, slot, side="right") - 1
    due, late_s = np.arange(widths.size) / rate_hz, np.zeros(widths.size)
    for index, by_s in late:
        late_s[index] = by_s
    return Record.from_arrays(
        time_s,
        widths[slot],
        torque,
        code,
        segment_names=[name for name, _, _ in segments],
        late_s=late_s[slot],
        pulses=Pulses(due, widths, late_s, np.zeros(widths.size, bool)),
        pulse_rate_hz=rate_hz,
    )


def means(time_s: Any, torque_nm: Any, rate_hz: float) -> tuple[Any, Any]:
    """Means over even bins, each at the middle of its bin; the samples themselves where there are not two for each."""
    if time_s.size < 2 * rate_hz * (time_s[-1] - time_s[0]):
        return time_s, torque_nm
    number = np.floor(time_s * rate_hz + 1e-9).astype(int)
    count = np.bincount(number)
    filled = np.flatnonzero(count)
    return (filled + 0.5) / rate_hz, (np.bincount(number, torque_nm)[filled] / count[filled])


def sample_times(host_time_s: list[float], counter: list[int]) -> Any:
    """When the samples were taken, on the test's clock: evenly by the cell's counter, set by those that came earliest.

    Samples arrive late and never early, so the line through their arrivals is drawn twice, the second time through
    those below the first.
    """
    host = np.array(host_time_s, float)
    number = np.array(counter, float)
    if number.min() < 0:  # the cell has none
        number = np.arange(host.size, dtype=float)
    number -= number[0]
    slope, first = np.polyfit(number, host, 1)
    early = host <= slope * number + first
    if early.sum() > 2 and np.ptp(number[early]) > 0.5 * np.ptp(number):
        slope = np.polyfit(number[early], host[early], 1)[0]
    return slope * number + float(np.quantile(host - slope * number, EARLIEST))
