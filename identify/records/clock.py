"""Times of samples as a uniform rate: freed of rounding and jitter, resampled where they are truly uneven.

Lost samples and pauses stay gaps: a record has no rows there. What was done is said in notes, unless nothing but the
rounding of the written times was taken away."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stimrig.identify.records import bounds
from stimrig.identify.records.record import Record
from stimrig.identify.records.table import Table

NEARLY = 0.9
"""Share of the pulse interval from which a sample is nearly as long."""
TRIALS = 400
"""Phases of the pulses that are tried in their interval."""
MOST_CHANGES = 2000
EXPLAINED = 0.9
"""Share of the changes of width that one phase of the pulses must explain, or the pulses do not keep to the rate."""
PAUSE_S = 1.0
"""A jump of the clock as long as this, at zero pulse width, is a pause between two tests."""
MOST_PAUSES = 1000
MOST_GAPS = 0.1
"""Share of the samples before which samples are missing, at most."""
NEAR = 0.75
"""Share of a step by which an even sample's time stamp may be off."""
SILENT = 0.1
"""Share of a step up to which jitter is not worth a word."""
GAP_STEPS = 3.0
"""Longer than so many usual steps is a gap where time stamps are uneven."""
BETTER = 0.98
"""The time stamps are taken as they are where torque is smoother over them by so much (mean square)."""
SAME_RATE = 0.002
INTERPOLATED = ("torque_nm", "angle_rad", "velocity_rad_s")


def pulse_phase_s(record: Record) -> float:
    """Time of the pulse slots after the first sample, modulo the pulse interval, s.

    A change of width seen first in the sample at t puts a pulse into (t - 1/rate, t]. The phase that satisfies the
    most changes is taken; of those, the latest (the pulse coincides with the sample that shows it).
    """
    changes = np.flatnonzero(np.diff(record.pulse_width_us)) + 1
    step_s, sample_s = 1.0 / record.pulse_rate_hz, 1.0 / record.sample_rate_hz
    if changes.size == 0 or sample_s > 0.999 * step_s:
        return 0.0
    latest = np.mod(record.time_s[changes] - record.time_s[0], step_s)
    latest, often = np.unique(np.round(latest, 9), return_counts=True)
    if sample_s > NEARLY * step_s:
        # All changes explain any phase but a sliver, the widest span without a change: it gives the phase.
        gaps = np.diff(np.r_[latest, latest[0] + step_s])
        widest = int(np.argmax(gaps))
        first = float(latest[(widest + 1) % latest.size])
        near = min(first, step_s - first) < 1e-3 * step_s
        return 0.0 if near or gaps[widest] < 0.5 * (step_s - sample_s) else first
    return _likeliest_phase(latest, often, np.full(latest.size, sample_s), step_s)[0]


def _likeliest_phase(latest_s: np.ndarray, often: np.ndarray, before_s: np.ndarray, step_s: float) -> tuple[float, int]:
    """The latest phase that explains the most changes, and how many: those with a pulse no more than `before_s` before
    the `latest_s` at which it can have come."""
    trial = np.linspace(0.0, step_s, TRIALS + 1)[:-1]
    hair = 1e-3 * before_s  # for rounding
    lag = np.mod(latest_s[:, None] - trial + hair[:, None], step_s)
    explained = often @ (lag < 1.002 * before_s[:, None])
    best = np.flatnonzero(explained == explained.max())
    anchor = trial[best[best.size // 2]]
    # From the anchor the earliest 'latest' time is the bound; take it exactly, free of the trial's spacing.
    offset_s = np.mod(latest_s - anchor + hair, step_s)
    inside = offset_s < 1.002 * before_s
    phase = float(np.mod(np.min((anchor + offset_s - hair)[inside]), step_s))
    return 0.0 if step_s - phase < 1e-9 else phase, int(explained.max())


class _Part(NamedTuple):
    """One stretch between two pauses."""

    even_s: np.ndarray | None  # its even times; None where it is to be resampled
    step_s: float
    lost: np.ndarray  # rows before which samples are missing
    jitter_s: float = 0.0


def regular(table: Table) -> Table:
    """The same with uniform times, and with notes on what of it was assumed; where it is resampled, pulses stay.

    Raises BadRecord: time does not rise, too few samples, or a rate that can't be used.
    """
    table = _with_finer_times(table)
    time_s = table.columns["time_s"]
    check_rising(table)
    edges = _pauses(table)
    parts = [_part(table, a, b) for a, b in pairwise(edges)]
    step_s = parts[0].step_s
    for part, edge in zip(parts, edges, strict=False):
        bounds.check_sampling(1 / part.step_s, table.at(edge))
        if abs(part.step_s - step_s) > SAME_RATE * step_s:
            message = f"sampled at {1 / part.step_s:.4g} Hz after a pause, {1 / step_s:.4g} Hz before it"
            raise table.bad(message, "Resample to one rate.", edge)
    even = [part.even_s for part in parts if part.even_s is not None]
    if len(even) < len(parts):
        return _resampled(table, step_s)
    worst, note = max(parts, key=lambda part: part.jitter_s), ""
    if worst.jitter_s:
        jitter = f"time stamps jitter by up to {1e3 * worst.jitter_s:.3g} ms"
        note = f"{jitter}: samples are taken as even, at {1 / worst.step_s:.5g} Hz, which suits the torque better"
    lost = _lost_note(table, time_s, np.concatenate([part.lost for part in parts]))
    return table.noting(note, lost, columns={"time_s": np.concatenate(even)})


def check_rising(table: Table) -> None:
    """Refuse times that do not rise, or are too few. Raises BadRecord."""
    time_s = table.columns["time_s"]
    bounds.check_size(time_s.size, table.at(0))
    gaps = np.diff(time_s)
    if (backwards := np.flatnonzero(~(gaps > 0))).size:
        row = int(backwards[0]) + 1
        verb, fix = "runs backwards", "Sort the rows by time, once each."
        if gaps[row - 1] == 0:
            verb = "stands still"
            fix += " Where times are rounded, give more digits, or the row's number divided by the sampling rate."
        raise table.bad(f"time {verb} at {time_s[row]:g} s", fix, row)


def _with_finer_times(table: Table) -> Table:
    """With even times where the stamps are only too coarsely rounded for the samples, so that some are equal."""
    time_s = table.columns["time_s"]
    if not np.any(np.diff(time_s) == 0) or time_s[-1] <= time_s[0]:
        return table
    line_s = np.linspace(time_s[0], time_s[-1], time_s.size)
    line_s += 0.5 * (np.max(time_s - line_s) + np.min(time_s - line_s))
    coarse_s = _resolution_s(time_s)
    if not 0.0 < np.max(np.abs(time_s - line_s)) <= NEAR * coarse_s:
        return table
    rate_hz = (time_s.size - 1) / (line_s[-1] - line_s[0])
    note = f"times are written to {1e3 * coarse_s:g} ms only: samples are taken as even, at {rate_hz:.5g} Hz"
    return table.noting(note, columns={"time_s": line_s})


def _pauses(table: Table) -> list[int]:
    """Rows at which a part begins, and the number of rows: tests of one session may follow after a pause at rest."""
    time_s, width_us = table.columns["time_s"], table.columns["pulse_width_us"]
    steps = np.diff(time_s)
    least_s = max(PAUSE_S, 20 * float(np.median(steps)))
    jumps = np.flatnonzero((steps >= least_s) & (width_us[:-1] == 0) & (width_us[1:] == 0)) + 1
    if jumps.size > MOST_PAUSES:
        raise table.bad(f"more than {MOST_PAUSES} pauses", "Give a record without holes.", int(jumps[MOST_PAUSES]))
    return [0, *jumps.tolist(), time_s.size]


def _part(table: Table, first: int, end: int) -> _Part:
    time_s, torque_nm = table.columns["time_s"][first:end], table.columns["torque_nm"][first:end]
    bounds.check_size(time_s.size, table.at(first))
    gaps = np.diff(time_s)
    typical_s = float(np.median(gaps))
    near = np.abs(gaps - typical_s) <= NEAR * typical_s
    mean_s = float(np.mean(gaps[near])) if near.any() else typical_s
    counts = np.where(near, 1.0, np.maximum(np.rint(gaps / mean_s), 1.0))
    index = np.concatenate([[0.0], np.cumsum(counts)])
    slope_s = float(time_s[-1] - time_s[0]) / index[-1]
    line_s = time_s[0] + slope_s * index
    # Rounding shifts all times alike: centre the line on the times that were written.
    line_s += float(np.median(time_s - line_s))
    jitter_s = float(np.max(np.abs(time_s - line_s)))
    lost = first + np.flatnonzero(counts > 1.5) + 1
    if jitter_s <= NEAR * slope_s:
        if jitter_s <= max(SILENT * slope_s, 0.6 * _resolution_s(time_s)):
            return _Part(line_s, slope_s, lost)
        slope_s, start_s = np.polyfit(index, time_s, 1)
        line_s, slope_s = start_s + slope_s * index, float(slope_s)
        if _roughness(time_s, torque_nm) > BETTER * _roughness(line_s, torque_nm):
            return _Part(line_s, slope_s, lost, jitter_s)
    return _Part(None, float(np.mean(gaps[gaps <= GAP_STEPS * typical_s])), lost)


def _resolution_s(time_s: np.ndarray) -> float:
    """Value of the last decimal place of the written times, s."""
    some = time_s[:: max(time_s.size // 1000, 1)]
    for places in range(7):
        if np.all(np.abs(some * 10**places - np.rint(some * 10**places)) < 1e-4):
            return 10.0**-places
    return 0.0


def _roughness(time_s: np.ndarray, torque_nm: np.ndarray) -> float:
    """Mean square by which a sample's torque is off the line between its neighbours, as a share of the noise in it."""
    share = (time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2])
    error = torque_nm[1:-1] - (1.0 - share) * torque_nm[:-2] - share * torque_nm[2:]
    return float(np.mean(error**2 / (1.0 + share**2 + (1.0 - share) ** 2)))


def _lost_note(table: Table, time_s: np.ndarray, rows: np.ndarray) -> str:
    if not rows.size:
        return ""
    if rows.size > max(MOST_PAUSES, MOST_GAPS * time_s.size):
        message = f"{rows.size} gaps in {time_s.size} samples"
        raise table.bad(message, "Give a record without holes.", int(rows[MOST_PAUSES]))
    longest_s = float(np.max(time_s[rows] - time_s[rows - 1]))
    number = "1 place" if rows.size == 1 else f"{rows.size} places"
    first = table.cell(int(rows[0]), "time_s")
    return f"samples are missing at {number} (first at {first}; longest {longest_s:.3g} s): left as gaps"


def _resampled(table: Table, step_s: float) -> Table:
    """The same at a uniform rate: torque and movement on straight lines between samples, gaps left open."""
    time_s = table.columns["time_s"]
    steps = np.diff(time_s)
    gap = steps > GAP_STEPS * np.median(steps)
    gaps, usual = np.flatnonzero(gap) + 1, steps[~gap]
    starts, ends = np.append(0, gaps), np.append(gaps, time_s.size) - 1
    first = np.ceil((time_s[starts] - time_s[0]) / step_s - 1e-6).astype(np.int64)
    count = np.maximum(np.floor((time_s[ends] - time_s[0]) / step_s + 1e-6).astype(np.int64) - first + 1, 0)
    index = np.repeat(first - np.cumsum(count) + count, count) + np.arange(int(count.sum()))
    even_s = time_s[0] + step_s * index
    before = np.clip(np.searchsorted(time_s, even_s + 1e-6 * step_s, side="right") - 1, 0, time_s.size - 2)
    share = np.clip((even_s - time_s[before]) / steps[before], 0.0, 1.0)
    columns = {
        name: (1.0 - share) * column[before] + share * column[before + 1] if name in INTERPOLATED else column[before]
        for name, column in table.columns.items()
    }
    width_us = _width_in_slots(table, even_s, before)
    stamps = f"uneven time stamps (steps of {1e3 * usual.min():.3g} to {1e3 * usual.max():.3g} ms)"
    made = f"resampled to {1 / step_s:.5g} Hz, torque on straight lines between samples"
    note = f"{stamps}: {made}: noise and error figures come out too small"
    columns |= {"time_s": even_s, "pulse_width_us": width_us}
    return table.noting(note, _lost_note(table, time_s, gaps), columns=columns)


def _width_in_slots(table: Table, at_s: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Pulse widths at the rising times `at_s`, shape (M,); `before` is the last sample at or before each.

    A change of width that a sample shows came with a pulse between it and the sample before. Pulses keep to their rate:
    all changes together give their phase far more closely than one. Where they do not, the last sample's width
    is used.
    """
    time_s, width_us, rate_hz = table.columns["time_s"], table.columns["pulse_width_us"], table.pulse_rate_hz
    changes = np.flatnonzero(np.diff(width_us)) + 1
    changes = changes[:: max(-(-changes.size // MOST_CHANGES), 1)]
    if changes.size:
        often, steps_s = np.ones(changes.size), time_s[changes] - time_s[changes - 1]
        phase_s, explained = _likeliest_phase(np.mod(time_s[changes], 1 / rate_hz), often, steps_s, 1 / rate_hz)
        if explained >= EXPLAINED * changes.size:
            slot_of, at_slot = (np.floor((moment_s - phase_s) * rate_hz + 1e-6) for moment_s in (time_s, at_s))
            # The last sample that lies in the slot or before it.
            before = np.maximum(np.searchsorted(slot_of, at_slot, side="right") - 1, 0)
    return width_us[before]
