"""A record put on its grid, and what its samples show before means are taken: hum, clipping and white noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stimrig.identify.dynamics.grid import Grid, make_grid, runs
from stimrig.identify.effects.mains_hum import HARMONICS, line
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.records.readings import (
    Readings,
    calm_samples,
    find_readings,
    flat_top,
    noise_of_readings,
    smoothed_readings,
)
from stimrig.identify.records.record import HELD_OUT, Record

LEAST_ROWS = 8
LEAST_LINE = 30.0
"""A line counts as hum if its power is this many times the mean power of its neighbours."""
FOLLOWED_S = 1.0
"""Window in which amplitude and phase of the hum are taken as constant."""
MAX_HARMONICS = 8


@dataclass(frozen=True)
class Raw:
    """Noise, hum and clipping in the samples of a record."""

    torque_nm: np.ndarray  # torque without mains hum, N·m, shape (N,)
    noise_sd_nm: float  # white noise of a sample, N·m
    hum: dict[str, float] | None  # parameters of the effect `mains_hum`; None if there is no hum
    ceiling_nm: float | None  # largest torque that the sensor shows, N·m; None if it does not clip there
    floor_nm: float | None  # smallest torque that the sensor shows, N·m; None if it does not clip there
    readings: Readings | None = None  # the readings behind the samples, if they are fewer or coarse


def block_means(grid: Grid, torque_nm: np.ndarray) -> np.ndarray:
    """Means over pulse intervals, N·m; NaN where there is no sample."""
    total = np.bincount(grid.interval, torque_nm, minlength=grid.size) / np.maximum(grid.count, 1)
    return np.where(grid.count > 0, total, np.nan)


def prepare(record: Record) -> tuple[Grid, Raw]:
    """Put a record on its grid, without hum and with its white noise; and what its samples show.

    Raises BadRecord, NotIdentifiable: no grid can be made, too few rows may be fitted, there is no pulse, or the
    torque never changes.
    """
    grid = make_grid(record)
    refuse_few(grid.fitted)
    if not np.max(grid.pulse_width_us[grid.fitted]) > 0:
        raise NotIdentifiable("the record has no pulse", fix="Record a PRBS and a ramp.")
    if not np.ptp(grid.torque_nm[grid.fitted]) > 0:
        raise NotIdentifiable("the torque never changes", fix="Check the load cell and the electrodes.")
    raw = inspect(record, grid.start_s)
    torque = block_means(grid, raw.torque_nm)
    return replace(grid, torque_nm=torque, noise_sd_nm=raw.noise_sd_nm, readings=raw.readings), raw


def refuse_few(rows: np.ndarray) -> None:
    """Refuse too few rows to fit. Raises NotIdentifiable: with their number."""
    if rows.sum() < LEAST_ROWS:
        fix = "Give rows of segments other than `validate`."
        raise NotIdentifiable(f"only {int(rows.sum())} pulse intervals may be fitted", fix=fix)


def rows_of(grid: Grid, names: Sequence[str]) -> np.ndarray:
    """bool, shape (K,): intervals of segments with these names."""
    wanted = np.array([name in names for name in grid.record.segment_names])
    return wanted[grid.segment]


def fitted_rows(grid: Grid, fit_on: Sequence[str] | None) -> np.ndarray:
    """Rows to fit: those of the named segments and the rests, which determine the baseline; never held-out pulses.

    Raises BadRequest: a named segment is not in the record (with those that are), or is the held-out one.
    NotIdentifiable: fewer than eight pulse intervals are left to fit.
    """
    there = tuple(dict.fromkeys(grid.record.segment_names))
    for name in fit_on or ():
        if name == HELD_OUT:
            raise BadRequest("rows of `validate` are never fitted", place="fit_on", fix="Name other segments.")
        if name not in there:
            raise BadRequest(f"no segment {name!r} in the record", place="fit_on", fix=f"It has: {', '.join(there)}.")
    rows = grid.fitted if fit_on is None else grid.fitted & rows_of(grid, (*fit_on, "rest"))
    refuse_few(rows)
    return rows


def inspect(record: Record, start_s: float | None = None) -> Raw:
    """Find hum, clipping and white noise in a record, without its held-out and doubted rows.

    The phase of the hum refers to `start_s`, by default the time of the first sample.
    """
    own_s = record.time_s - (record.time_s[0] if start_s is None else start_s)
    usable = ~record.held_out if record.doubted is None else ~record.held_out & ~record.doubted
    torque = record.torque_nm
    ceiling, floor = flat_top(torque[usable]), flat_top(-torque[usable])
    known = runs(usable)
    hum = find_hum(record, own_s, usable, known)
    if hum is not None:
        torque = torque - line(hum, own_s)
        torque = torque - hum_variation(record, torque, hum["frequency_hz"], known)
    noise, readings = white_noise(record, usable, torque)
    noise = min(noise, float(np.std(torque[usable])))  # jumps alone may seem more
    return Raw(torque, noise, hum, ceiling, None if floor is None else -floor, readings)


def white_noise(record: Record, rows: np.ndarray, torque_nm: np.ndarray) -> tuple[float, Readings | None]:
    """Robust estimate of the white noise of a sample from third (or fourth) differences, N·m, and the readings.

    At low sampling rates the torque changes from sample to sample; the estimate is then an upper bound. So it is for
    samples that are held, coarse, interpolated or smoothed, if the muscle never rests for long.

    `record`: what was measured. `rows`: shape (N,); samples that may be looked at. `torque_nm`: shape (N,); torque
    without mains hum, N·m.
    """
    torque, width = torque_nm[rows], record.pulse_width_us[rows]
    if torque.size < 16:
        return float(np.std(torque)), None
    rate_hz = record.sample_rate_hz
    readings = find_readings(record.torque_nm[rows])
    # Sampled more slowly, a tremor or an aliased line looks like smoothed noise.
    if readings is None and rate_hz >= 4.0 * record.pulse_rate_hz:
        readings = smoothed_readings(torque, calm_samples(width, rate_hz, rest=True))
    samples_each = 1.0 if readings is None else readings.samples_each
    order = 3 if rate_hz > 3.0 * record.pulse_rate_hz * samples_each else 4
    if readings is not None:
        noise = noise_of_readings(torque, calm_samples(width, rate_hz), readings, order)
        held_s = samples_each / rate_hz if readings.kind in ("held", "interpolated") else 0.0
        return noise, replace(readings, at=np.flatnonzero(rows)[readings.at], held_s=held_s)
    difference = np.diff(torque, order)
    gain = {3: 20.0, 4: 70.0}[order]
    return float(np.sqrt(np.median(difference**2) / 0.4549 / gain)), None


def find_hum(record: Record, own_s: np.ndarray, usable: np.ndarray, known: list[slice]) -> dict[str, float] | None:
    """Parameters of the mains hum: a line at 50 or 60 Hz and its harmonics; None if there is none."""
    rate_hz = record.sample_rate_hz
    if rate_hz < 99.0 or usable.sum() < 4 * rate_hz:
        return None
    longest = max(known, key=lambda run: run.stop - run.start)
    # Differences whiten the spectrum of the muscle, so that neighbouring frequencies can be compared.
    signal = np.diff(record.torque_nm[longest], 2)
    # The FFT is slow for lengths with a large prime factor: up to 1 % of the samples are left out.
    signal = signal[: signal.size - signal.size % (1 << max(signal.size.bit_length() - 7, 0))]
    window = np.hanning(signal.size)
    power = np.abs(np.fft.rfft((signal - signal.mean()) * window)) ** 2
    frequency = np.fft.rfftfreq(signal.size, 1.0 / rate_hz)
    best: tuple[float, float] = (0.0, 0.0)
    for mains in (50.0, 60.0):
        ratio = max(
            _line(power, frequency, h * mains, h * 0.3) / (1.0 if h == 1 else 1.5)
            for h in range(1, HARMONICS + 1)
            if h * mains < 0.5 * rate_hz - 1e-6 or h == 1
        )
        best = max(best, (ratio, mains))
    ratio, mains = best
    if ratio < LEAST_LINE or mains > 0.5 * rate_hz + 1e-6:
        return None
    return _fit_hum(record, own_s, mains, usable)


def _line(power: np.ndarray, frequency: np.ndarray, centre_hz: float, reach_hz: float) -> float:
    """Power of a line divided by the mean power of its neighbours."""
    near = slice(*np.searchsorted(frequency, (centre_hz - 8.1, centre_hz + 8.1)))
    frequency, power = frequency[near], power[near]
    inside = np.abs(frequency - centre_hz) <= reach_hz
    # Neighbours within 8 Hz only, since the pulses at 40 Hz have harmonics, too.
    around = (np.abs(frequency - centre_hz) <= 8.0) & (np.abs(frequency - centre_hz) > 2 * reach_hz + 0.2)
    if not inside.any() or not around.any():
        return 0.0
    return float(power[inside].max() / max(np.mean(power[around]), 1e-30))


def hum_variation(record: Record, torque: np.ndarray, mains_hz: float, known: list[slice]) -> np.ndarray:
    """Hum that remains because its amplitude and phase vary, N·m: each harmonic is tracked with a window of 1 s."""
    rate_hz = record.sample_rate_hz
    width = 2 * max(round(rate_hz / record.pulse_rate_hz), 2) + 1
    box = np.ones(width) / width
    window = np.hanning(max(round(FOLLOWED_S * rate_hz), 8) + 2)[1:-1]
    variation = np.zeros(torque.size)
    for run in known:
        part = torque[run]
        if part.size < 2 * window.size:
            continue
        high = part - np.convolve(np.convolve(part, box, "same"), box, "same")
        high[: 2 * width] = high[-2 * width :] = 0.0
        weight = np.convolve(np.abs(high) > 0, window, "same")
        h = 1
        while h * mains_hz < 0.5 * rate_hz - 1.0 and h <= MAX_HARMONICS:
            turn = np.exp(2j * np.pi * h * mains_hz * record.time_s[run])
            half = np.pi * h * mains_hz / rate_hz
            passed = 1.0 - (np.sin(width * half) / (width * np.sin(half))) ** 2
            slow = np.convolve(high * np.conj(turn), window, "same") / np.maximum(weight, 1e-9)
            variation[run] += 2.0 * np.real(slow * turn) / passed
            h += 1
    return variation


def _fit_hum(record: Record, time_s: np.ndarray, mains_hz: float, usable: np.ndarray) -> dict[str, float]:
    """Frequency and amplitudes, by least squares on the high-pass filtered torque."""
    rate_hz = record.sample_rate_hz
    width = max(round(rate_hz / record.pulse_rate_hz), 2)
    harmonics = [h for h in range(1, HARMONICS + 1) if h * mains_hz <= 0.5 * rate_hz + 1e-6]
    # Rows next to excluded ones are left out, since the filter would mix them.
    usable = np.convolve(~usable, np.ones(4 * width + 1), "same") < 0.5

    def smooth_out(values: np.ndarray) -> np.ndarray:
        box = np.ones(2 * width + 1) / (2 * width + 1)
        return values - np.apply_along_axis(lambda c: np.convolve(np.convolve(c, box, "same"), box, "same"), 0, values)

    target = smooth_out(record.torque_nm)[usable]

    def design(frequency_hz: float) -> np.ndarray:
        turn = 2 * np.pi * frequency_hz * time_s[:, None] * np.array(harmonics)
        return np.concatenate([np.cos(turn), np.sin(turn)], axis=1)

    def remaining(frequency_hz: float) -> tuple[float, np.ndarray]:
        columns = smooth_out(design(frequency_hz))[usable]
        solution = np.linalg.lstsq(columns, target, rcond=1e-6)[0]
        return float(np.sum((target - columns @ solution) ** 2)), solution

    centre, reach = mains_hz, 0.3
    for _ in range(3):
        trials = np.linspace(centre - reach, centre + reach, 13)
        centre = float(trials[np.argmin([remaining(f)[0] for f in trials])])
        reach /= 5.0
    _, solution = remaining(centre)
    hum = {"frequency_hz": centre}
    for h in range(1, HARMONICS + 1):
        for offset, part in ((0, "cos"), (len(harmonics), "sin")):
            hum[f"{part}_{h}_nm"] = float(solution[harmonics.index(h) + offset]) if h in harmonics else 0.0
    return hum
