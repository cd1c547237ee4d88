"""A record put on the grid of its pulses."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.pulse_grid import Grid, runs
from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.pulse_phase import pulse_phase_s
from stimrig.identify.records.record import FORGOTTEN_S, Record


def make_grid(record: Record) -> Grid:
    """Put a record on the grid of its pulses.

    Raises
    ------
    BadRecord
        Fewer than eight pulse intervals, or sampled more slowly than the pulses.
    """
    check_arrays(record)
    step_s = 1.0 / record.pulse_rate_hz
    rate_hz = record.sample_rate_hz
    if not rate_hz >= 0.999 * record.pulse_rate_hz:
        raise BadRecord(
            f"sampled at {rate_hz:.4g} Hz, below the {record.pulse_rate_hz:g} pulses a second",
            fix="Record at 40 Hz or faster.",
        )
    start_s = record.time_s[0] + pulse_phase_s(record)
    # A small shift, so that a sample taken at the pulse itself falls into the interval that starts with the pulse.
    position = (record.time_s - start_s) / step_s + 1e-6 + 1e-3 * min(1.0, record.pulse_rate_hz / rate_hz)
    interval = np.floor(position).astype(np.int64)
    lowest = int(interval[0])
    start_s, position, interval = start_s + lowest * step_s, position - lowest, interval - lowest
    size = int(interval[-1]) + 1
    if size < 8:
        raise BadRecord(f"only {size} pulse intervals long", fix="Give at least a few seconds of data.")
    count = np.bincount(interval, minlength=size)
    filled = np.maximum(count, 1)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.bincount(interval, values, minlength=size) / filled
        return np.where(count > 0, total, np.nan)

    first_of = np.searchsorted(interval, np.arange(size))
    # The middle sample of an interval: a pulse one sample early or late does not change it.
    middle = np.minimum(first_of + count // 2, record.time_s.size - 1)
    # Where samples are missing, the last known width is assumed.
    middle = np.where(count > 0, middle, np.maximum(first_of - 1, 0))
    following = record.part[np.minimum(first_of, record.time_s.size - 1)]
    part = record.part[middle]
    pause = (count == 0) & (following != part)
    width, late_s, doubted, resumed = _applied(record, middle, start_s, step_s, (count == 0) & ~pause, part)
    # There is no stimulation between two parts, whatever the width at the end of the first.
    width[pause] = 0.0
    if late_s is not None:
        late_s[pause] = 0.0
    if record.doubted is not None:
        doubted |= np.bincount(interval, record.doubted, minlength=size) > 0
    return Grid(
        record=record,
        start_s=start_s,
        step_s=step_s,
        pulse_width_us=width,
        torque_nm=mean(record.torque_nm),
        count=count,
        interval=interval,
        fraction=np.clip((record.time_s - start_s) / step_s - interval, 0.0, 1.0),
        held_out=np.bincount(interval, record.held_out, minlength=size) > 0,
        segment=record.segment[middle],
        angle_rad=None if record.angle_rad is None else mean(record.angle_rad),
        velocity_rad_s=None if record.velocity_rad_s is None else mean(record.velocity_rad_s),
        late_s=late_s,
        doubted=doubted,
        part=part,
        resumed=resumed,
    )


def _applied(
    record: Record, middle: np.ndarray, start_s: float, step_s: float, gaps: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]:
    """Width and lateness of each interval, whether its stimulation is unknown, and where the state is then unknown.

    Where samples are missing, the record's list of pulses is used, if it has one. Otherwise the stimulation in the gap
    is unknown, except between two rests with the same torque. After such a gap the state is unknown, and the intervals
    are doubted as long as a delayed response to the gap may last; held-out rows until the muscle has forgotten it.
    """
    width = record.pulse_width_us[middle]
    late = np.zeros(width.size) if record.late_s is None else record.late_s[middle]
    doubted, resumed = np.zeros(width.size, bool), []
    if gaps.any() and record.pulses is not None:
        known = record.pulses
        place = np.round((known.time_s - start_s) / step_s).astype(np.int64)
        inside = (place >= 0) & (place < width.size)
        for target, values in ((width, known.width_us), (late, known.late_s)):
            told = np.zeros(width.size)
            told[place[inside]] = values[inside]
            target[gaps] = told[gaps]
    elif gaps.any():
        for gap in runs(gaps):
            if not (width[gap.start - 1] or _moved(record, middle, gap)):
                continue
            # The initial state of held-out rows cannot be fitted: the muscle must have forgotten the gap.
            unseen = record.held_out[middle[gap.stop]]
            reach_s = FORGOTTEN_S if unseen else LONGEST_DELAY_S
            after = slice(gap.start, gap.stop + round(reach_s / step_s))
            doubted[after] |= part[after] == part[gap.start]
            if not unseen:
                resumed.append(gap.stop)
    return width, late if late.any() else None, doubted, np.array(resumed, np.int64)


def _moved(record: Record, middle: np.ndarray, gap: slice) -> bool:
    """Whether the torque differs before and after a gap: then stimulation was cut out between two rests."""
    before, after = middle[max(gap.start - 2, 0)], middle[min(gap.stop, middle.size - 1)]
    near = max(round(record.sample_rate_hz / record.pulse_rate_hz), 1)
    levels = [float(np.mean(record.torque_nm[at : at + near])) for at in (before, after)]
    return abs(levels[1] - levels[0]) > MOVED * float(np.ptp(record.torque_nm))


MOVED = 0.04
"""Share of the torque's range by which the rests before and after a gap differ if stimulation was cut out."""
LONGEST_LATE_S = bounds.LARGEST["late_s"]
LONGEST_DELAY_S = 0.25
"""Longest time from a pulse to the first response; a longer memory is part of the state."""


def check_arrays(record: Record) -> None:
    """Refuse arrays that no measurement gives, wherever they come from.

    Raises
    ------
    BadRecord
        Not finite, negative widths, time that does not rise, an impossible pulse rate, or longer than a day.
    """
    bounds.check_rate(record.pulse_rate_hz, "pulse_rate_hz")
    columns = {"time_s": record.time_s, "pulse_width_us": record.pulse_width_us, "torque_nm": record.torque_nm}
    for name, column in columns.items():
        finite = np.isfinite(column)
        if not finite.all():
            raise BadRecord(
                "not finite",
                place=f"{name}, sample {int(np.argmin(finite))}",
                fix="Cut the record before this sample.",
            )
    if record.late_s is not None and (wild := np.flatnonzero(~(np.abs(record.late_s) <= LONGEST_LATE_S))).size:
        raise BadRecord(
            f"{record.late_s[wild[0]]:g} s late",
            place=f"late_s, sample {int(wild[0])}",
            fix="Give `late_s` in seconds.",
        )
    if np.any(record.pulse_width_us < 0):
        place = f"pulse_width_us, sample {int(np.argmax(record.pulse_width_us < 0))}"
        raise BadRecord("negative", place=place, fix="A pulse width is 0 (no pulse) or positive.")
    if np.any(np.diff(record.time_s) <= 0):
        place = f"time_s, sample {int(np.argmax(np.diff(record.time_s) <= 0)) + 1}"
        raise BadRecord("time does not rise", place=place, fix="Sort the samples by time; each time once.")
    if record.time_s[-1] - record.time_s[0] > bounds.LONGEST_S:
        raise BadRecord("longer than a day", place="time_s", fix="Give the time in seconds.")
