"""Times of samples as a uniform rate: freed of rounding and jitter, resampled where they are truly uneven.

Lost samples and pauses stay gaps: a record has no rows there. What was done is said in notes, unless nothing but the
rounding of the written times was taken away."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.file_content import FileContent
from stimrig.identify.records.record import Record

NEARLY = 0.9
"""Share of the pulse interval from which a sample is nearly as long."""


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
    trial = np.linspace(0.0, step_s, 401)[:-1]
    # Count the changes that each trial phase explains, with a tolerance of a hair for rounding.
    lag = np.mod(latest[:, None] - trial[None, :] + 1e-3 * sample_s, step_s)
    explained = often @ (lag < sample_s * 1.002)
    best = np.flatnonzero(explained == explained.max())
    anchor = trial[best[best.size // 2]]
    # From the anchor the earliest 'latest' time is the bound; take it exactly, free of the trial's spacing.
    offset_s = np.mod(latest - anchor + 1e-3 * sample_s, step_s)
    inside = offset_s[offset_s < sample_s * 1.002]
    phase = float(np.mod(anchor + np.min(inside) - 1e-3 * sample_s, step_s))
    return 0.0 if step_s - phase < 1e-9 else phase


MOST_CHANGES = 2000
TRIALS = 400
EXPLAINED = 0.9
"""Share of the changes of width that one phase of the pulses must explain, or the pulses do not keep to the rate."""


def _width_in_slots(file: FileContent, at_s: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Pulse widths at the rising times `at_s`, shape (M,); `before` is the last sample at or before each.

    A change of width that a sample shows came with a pulse between it and the sample before. Pulses keep to their rate:
    all changes together give their phase far more closely than one. Where they do not, the last sample's width
    is used.
    """
    time_s, width_us, pulse_rate_hz = file.columns["time_s"], file.columns["pulse_width_us"], file.pulse_rate_hz
    phase_s = _phase_s(time_s, width_us, pulse_rate_hz)
    if phase_s is None:
        return width_us[before]
    hair = 1e-6

    def slot(moment_s: np.ndarray) -> np.ndarray:
        return np.floor((moment_s - phase_s) * pulse_rate_hz + hair)

    # The last sample that lies in the slot or before it.
    last = np.searchsorted(slot(time_s), slot(at_s), side="right") - 1
    return width_us[np.maximum(last, 0)]


def _phase_s(time_s: np.ndarray, width_us: np.ndarray, pulse_rate_hz: float) -> float | None:
    """Phase of the pulses in their interval, s: the latest one that explains the most changes; None for none."""
    changes = np.flatnonzero(np.diff(width_us)) + 1
    if not changes.size:
        return None
    changes = changes[:: -(-changes.size // MOST_CHANGES)]
    step_s = 1.0 / pulse_rate_hz
    change_phase_s, before_s = np.mod(time_s[changes], step_s), time_s[changes] - time_s[changes - 1]
    trial = np.arange(TRIALS) * step_s / TRIALS
    explained = np.sum(np.mod(change_phase_s[:, None] - trial + 1e-9, step_s) < before_s[:, None], axis=0)
    if explained.max() < EXPLAINED * changes.size:
        return None
    best = float(trial[np.argmax(explained)])
    offset_s = np.mod(change_phase_s - best + 1e-9, step_s)
    return best + float(np.min(offset_s[offset_s < before_s])) - 1e-9


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


@dataclass(frozen=True)
class _Part:
    """One stretch between two pauses: its even times, or None where it is to be resampled; and its step, s."""

    even_s: np.ndarray | None
    step_s: float
    lost: np.ndarray
    """Rows before which samples are missing."""
    jitter_s: float = 0.0


def regular(file: FileContent) -> FileContent:
    """The same with uniform times, and with notes on what of it was assumed; where it is resampled, pulses stay.

    Raises BadRecord: time does not rise, too few samples, or a rate that can't be used.
    """
    time_s, note = _finer(file.columns["time_s"])
    file = file.noting(note, columns=file.columns | {"time_s": time_s})
    _check_rising(file)
    edges = _pauses(file)
    parts = [_part(file, a, b) for a, b in pairwise(edges)]
    step_s = parts[0].step_s
    for part, edge in zip(parts, edges, strict=False):
        bounds.check_sampling(1 / part.step_s, file.at(edge))
        if abs(part.step_s - step_s) > SAME_RATE * step_s:
            message = f"sampled at {1 / part.step_s:.4g} Hz after a pause, {1 / step_s:.4g} Hz before it"
            raise BadRecord(message, place=file.at(edge), fix="Resample to one rate.")
    even = [part.even_s for part in parts if part.even_s is not None]
    if len(even) < len(parts):
        return _resampled(file, step_s)
    lost = _lost_note(file, np.concatenate([part.lost for part in parts]))
    return file.noting(_jitter_note(parts), lost, columns=file.columns | {"time_s": np.concatenate(even)})


def _check_rising(file: FileContent) -> None:
    time_s = file.columns["time_s"]
    bounds.check_size(time_s.size, file.at(0))
    gaps = np.diff(time_s)
    backwards = np.flatnonzero(~(gaps > 0))
    if backwards.size:
        index = int(backwards[0]) + 1
        verb = "stands still" if gaps[index - 1] == 0 else "runs backwards"
        fix = "Sort the rows by time, once each."
        raise BadRecord(f"time {verb} at {time_s[index]:g} s", place=file.at(index), fix=fix)


def _finer(time_s: np.ndarray) -> tuple[np.ndarray, str]:
    """Even times where the stamps are only too coarsely rounded for the samples, so that some are equal; and a note."""
    if not np.any(np.diff(time_s) == 0):
        return time_s, ""
    line_s = np.linspace(time_s[0], time_s[-1], time_s.size)
    line_s += 0.5 * (np.max(time_s - line_s) + np.min(time_s - line_s))
    coarse_s = _resolution_s(time_s)
    if not 0.0 < np.max(np.abs(time_s - line_s)) <= NEAR * coarse_s or time_s[-1] <= time_s[0]:
        return time_s, ""
    rate_hz = (time_s.size - 1) / (line_s[-1] - line_s[0])
    return line_s, f"times are written to {1e3 * coarse_s:g} ms only: samples are taken as even, at {rate_hz:.5g} Hz"


def _pauses(file: FileContent) -> list[int]:
    """Rows at which a part begins, and the number of rows: tests of one session may follow after a pause at rest."""
    time_s, width_us = file.columns["time_s"], file.columns["pulse_width_us"]
    steps = np.diff(time_s)
    least_s = max(PAUSE_S, 20 * float(np.median(steps)))
    jumps = np.flatnonzero((steps >= least_s) & (width_us[:-1] == 0) & (width_us[1:] == 0)) + 1
    if jumps.size > MOST_PAUSES:
        fix = "Give a record without holes."
        raise BadRecord(f"more than {MOST_PAUSES} pauses", place=file.at(int(jumps[MOST_PAUSES])), fix=fix)
    return [0, *jumps.tolist(), time_s.size]


def _part(file: FileContent, first: int, end: int) -> _Part:
    time_s, torque_nm = file.columns["time_s"][first:end], file.columns["torque_nm"][first:end]
    bounds.check_size(time_s.size, file.at(first))
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


def _jitter_note(parts: list[_Part]) -> str:
    worst = max(parts, key=lambda part: part.jitter_s)
    if not worst.jitter_s:
        return ""
    return (
        f"time stamps jitter by up to {1e3 * worst.jitter_s:.3g} ms: samples are taken as even, at "
        f"{1 / worst.step_s:.5g} Hz, which suits the torque better"
    )


def _lost_note(file: FileContent, rows: np.ndarray) -> str:
    time_s = file.columns["time_s"]
    if not rows.size:
        return ""
    if rows.size > max(MOST_PAUSES, MOST_GAPS * time_s.size):
        place = file.at(int(rows[MOST_PAUSES]))
        raise BadRecord(f"{rows.size} gaps in {time_s.size} samples", place=place, fix="Give a record without holes.")
    longest_s = float(np.max(time_s[rows] - time_s[rows - 1]))
    places = "1 place" if rows.size == 1 else f"{rows.size} places"
    first = int(rows[0])
    return (
        f"samples are missing at {places} (first at {file.cell(first, 'time_s')}; longest {longest_s:.3g} s): "
        "left as gaps"
    )


def _resampled(file: FileContent, step_s: float) -> FileContent:
    """The same at a uniform rate: torque and movement on straight lines between samples, gaps left open."""
    time_s = file.columns["time_s"]
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
        for name, column in file.columns.items()
    }
    columns["time_s"] = even_s
    columns["pulse_width_us"] = _width_in_slots(file, even_s, before)
    note = (
        f"uneven time stamps (steps of {1e3 * usual.min():.3g} to {1e3 * usual.max():.3g} ms): resampled to "
        f"{1 / step_s:.5g} Hz, torque on straight lines between samples: "
        "noise and error figures come out too small"
    )
    return file.noting(note, _lost_note(file, gaps), columns=columns)
