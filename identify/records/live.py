"""A record of the samples that a running test has sent so far: `live_record`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stimrig.identify.records.pulse_times import ON_ITS_WAY, RESTS, Sent, in_force, locate_pulses
from stimrig.identify.records.record import Record

BINS = 5
"""Means for each pulse interval, where a load cell gives at least twice as many samples: the delay of a sample's way to
the host, some milliseconds that only a sealed recording corrects, is then within the one sample that the fit allows."""
SAMPLE = np.dtype(
    [("host_time_s", "<f8"), ("stamp_s", "<f8"), ("torque_nm", "<f8"), ("counter", "<i8"), ("sync", "u1")]
)
"""As `stimrig.rig.messages.TORQUE_ROW`."""
Segments = Sequence[tuple[str, int, int]]
"""Name, first pulse and end of each."""


def live_record(
    samples: Any, zero_s: float, outcomes: Mapping[str, Any], laid_us: list[float], segments: Segments, rate_hz: float
) -> Record | None:
    """Return the record of what was measured since the first pulse, for `decide`; None where there is nothing yet.

    Pulses are those that were felt, by the same rules as in a sealed recording.
    """
    if samples.size < 2:
        return None
    time_s = sample_times(samples["host_time_s"] - zero_s, samples["counter"])
    whole_s = min(np.floor(time_s[-1] * rate_hz), len(laid_us)) / rate_hz  # of an interval's begin a mean is noisy
    inside = np.isfinite(samples["torque_nm"]) & (time_s >= 0) & (time_s < whole_s - 1e-9)
    if not inside.any():
        return None
    time_s, torque, sync = time_s[inside], samples["torque_nm"][inside], samples["sync"][inside]
    pulse_count = int(time_s[-1] * rate_hz) + 1
    pulses, doubted = locate_pulses(_sent(outcomes, laid_us[:pulse_count], rate_hz), time_s, sync)
    even_s, torque = bin_means(time_s, torque, BINS * rate_hz)
    width_us, late_s = in_force(pulses, even_s, rate_hz)
    code = np.searchsorted([start for _, start, _ in segments], even_s * rate_hz + 1e-9, side="right") - 1
    return Record.from_arrays(
        even_s, width_us, torque, code, segment_names=[name for name, _, _ in segments], late_s=late_s,
        doubted=np.interp(even_s, time_s, doubted) > 0, pulses=pulses, pulse_rate_hz=rate_hz,
    )  # fmt: skip


def _sent(outcomes: Mapping[str, Any], laid_us: list[float], rate_hz: float) -> Any:
    """Return what is known of each pulse; one whose outcome is not known yet is on its way."""
    widths_us = np.array(laid_us, float)
    written_s, acknowledged_s = np.full(widths_us.size, np.nan), np.full(widths_us.size, np.nan)
    status = np.where(widths_us > 0, ON_ITS_WAY, RESTS)
    index = np.array(outcomes["index"], int)
    is_laid = index < widths_us.size
    columns = {"pulse_width_us": widths_us, "written_time_s": written_s, "acknowledged_time_s": acknowledged_s}
    for name, column in {**columns, "status": status}.items():
        column[index[is_laid]] = np.array(outcomes[name], float)[is_laid]
    return Sent(np.arange(widths_us.size) / rate_hz, widths_us, written_s, acknowledged_s, status, 1.0 / rate_hz)


def bin_means(time_s: Any, torque_nm: Any, rate_hz: float) -> tuple[Any, Any]:
    """Average over even bins, each at its middle; return the samples where there are not two for each bin."""
    if time_s.size < 2 * rate_hz * (time_s[-1] - time_s[0]):
        return time_s, torque_nm
    number = np.floor(time_s * rate_hz + 1e-9).astype(int)
    count = np.bincount(number)
    filled = np.flatnonzero(count)
    return (filled + 0.5) / rate_hz, (np.bincount(number, torque_nm)[filled] / count[filled])


def sample_times(host_s: Any, counter: Any) -> Any:
    """Estimate when the samples were taken: evenly by the cell's counter, on the line below all arrivals.

    Samples arrive late and never early, after a pause of the computer all of it at once: so no arrival lies below the
    line. Of such lines it is the highest one in the record's middle, an edge of the arrivals' lower convex hull.
    """
    number = np.array(counter, float)
    if number.min() < 0:  # the cell has none
        number = np.arange(host_s.size, dtype=float)
    number -= number[0]
    hull: list[Any] = []
    latest = np.r_[np.diff(host_s) > 0, True]  # of those that came at once
    for point in np.column_stack([number, host_s])[latest].tolist():
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    corners = np.array(hull)
    after = int(np.clip(np.searchsorted(corners[:, 0], number.mean()), 1, len(corners) - 1))
    (start, start_s), (end, end_s) = corners[after - 1], corners[after]
    return start_s + (end_s - start_s) / (end - start) * (number - start)


def _turn(first: Any, second: Any, third: Any) -> float:
    """Return a value above 0 where the way from the first point to the third turns upwards at the second."""
    return (second[0] - first[0]) * (third[1] - first[1]) - (second[1] - first[1]) * (third[0] - first[0])
