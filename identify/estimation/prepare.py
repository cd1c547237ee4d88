"""From a record to a set-up: hum, clipping and white noise at the record's own rate, then the common spline."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from identify.dynamics.pulse_grid import Grid, make_grid, runs
from identify.effects.mains_hum import HARMONICS, line
from identify.errors import NotIdentifiable
from identify.estimation.joint import Fitted, solve
from identify.estimation.projected import Solution, estimate
from identify.noise.level import NoiseLevel
from identify.records.record import Record
from identify.simulation.problem import Problem
from identify.simulation.setup import Setup

LEAST_LINE = 30.0
"""Power of a mains line over its neighbours' median that counts as hum."""
FOLLOWED_S = 1.0
"""Window over which hum's amplitude and phase are taken as even: the grid's frequency wanders more slowly."""
MOST_HARMONICS = 8
LEAST_SPREAD = 0.2
"""Noise of a part over the largest of all parts, at least."""
LEAST_ROWS = 8
HARDLY_FELT_S, QUICK_S = 1e-3, 3e-3
"""A second lag below the first changes next to nothing, so a search is stuck there: it begins anew at QUICK_S."""
LEAST_EQUAL = 20
"""Samples at exactly the greatest (or smallest) value that count as clipping."""


@dataclass(frozen=True)
class Raw:
    """What is seen before averaging.

    Parameters
    ----------
    torque_nm : ndarray, shape (N,)
        Without the hum, N·m.
    noise_sd_nm : float
        White noise of a sample, N·m.
    hum : dict or None
        Parameters of `mains_hum`; None where there is no line.
    ceiling_nm, floor_nm : float or None
        Clipping level, N·m.
    """

    torque_nm: np.ndarray
    noise_sd_nm: float
    hum: dict[str, float] | None
    ceiling_nm: float | None
    floor_nm: float | None


def inspect(record: Record, start_s: float | None = None) -> Raw:
    """Hum, clipping and white noise of a record; held-out rows are left out, as everywhere.

    Hum is told by cosines and sines of the time since `start_s`, the record's first sample by default.
    """
    own_s = record.time_s - (record.time_s[0] if start_s is None else start_s)
    kept = ~record.held_out if record.doubted is None else ~record.held_out & ~record.doubted
    torque = record.torque_nm
    ceiling, floor = _flat(torque[kept]), _flat(-torque[kept])
    hum = _find_hum(record, own_s, kept)
    if hum is not None:
        torque = torque - line(hum, own_s)
        torque = torque - _wander(record, torque, hum["frequency_hz"], kept)
    noise = white_noise(record, torque[kept])
    return Raw(torque, noise, hum, ceiling, None if floor is None else -floor)


def _flat(torque: np.ndarray) -> float | None:
    """The greatest value, where it comes far too often for a noisy signal."""
    top = float(torque.max())
    equal = int(np.sum(torque == top))
    if equal < LEAST_EQUAL or top == float(torque.min()):
        return None
    # Coarse quantisation repeats every value: the ceiling must repeat far more than the next values below it.
    values, counts = np.unique(torque[torque > top - 0.25 * (top - float(np.median(torque)))], return_counts=True)
    below = counts[values < top]
    # A quiet record resting at its greatest value isn't clipped.
    if below.size == 0 or equal < 4 * np.max(below):
        return None
    return top


def white_noise(record: Record, torque: np.ndarray) -> float:
    """White noise of a sample, from third differences, robustly, N·m.

    At the pulse rate itself the torque moves between samples; there the estimate is an upper bound.
    """
    if torque.size < 16:
        return float(np.std(torque))
    order = 3 if record.sample_rate_hz > 3.0 * record.pulse_rate_hz else 4
    difference = np.diff(torque, order)
    gain = {3: 20.0, 4: 70.0}[order]
    return float(np.sqrt(np.median(difference**2) / 0.4549 / gain))


def _find_hum(record: Record, own_s: np.ndarray, kept: np.ndarray) -> dict[str, float] | None:
    """A line at 50 or 60 Hz that stands out of its neighbours, with its harmonics."""
    rate_hz = record.sample_rate_hz
    if rate_hz < 99.0 or kept.sum() < 4 * rate_hz:
        return None
    longest = max(runs(kept), key=lambda run: run.stop - run.start)
    # Differences whiten the muscle's own spectrum, so that neighbours are comparable.
    signal = np.diff(record.torque_nm[longest], 2)
    # A length with a large prime factor takes five times as long: a hundredth of the samples is given up for it.
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
    return _fit_hum(record, own_s, mains, kept)


def _line(power: np.ndarray, frequency: np.ndarray, centre_hz: float, reach_hz: float) -> float:
    inside = np.abs(frequency - centre_hz) <= reach_hz
    # The 40 Hz pulses have harmonics of their own; neighbours within 8 Hz but outside of the line.
    around = (np.abs(frequency - centre_hz) <= 8.0) & (np.abs(frequency - centre_hz) > 2 * reach_hz + 0.2)
    if not inside.any() or not around.any():
        return 0.0
    return float(power[inside].max() / max(np.mean(power[around]), 1e-30))


def _wander(record: Record, torque: np.ndarray, mains_hz: float, kept: np.ndarray) -> np.ndarray:
    """What amplitude and phase of hum do beside the even line, N·m: each harmonic followed over a second."""
    rate_hz = record.sample_rate_hz
    width = 2 * max(round(rate_hz / record.pulse_rate_hz), 2) + 1
    box = np.ones(width) / width
    window = np.hanning(max(round(FOLLOWED_S * rate_hz), 8) + 2)[1:-1]
    found = np.zeros(torque.size)
    for run in runs(kept):
        part = torque[run]
        if part.size < 2 * window.size:
            continue
        high = part - np.convolve(np.convolve(part, box, "same"), box, "same")
        high[: 2 * width] = high[-2 * width :] = 0.0
        weight = np.convolve(np.abs(high) > 0, window, "same")
        h = 1
        while h * mains_hz < 0.5 * rate_hz - 1.0 and h <= MOST_HARMONICS:
            turn = np.exp(2j * np.pi * h * mains_hz * record.time_s[run])
            half = np.pi * h * mains_hz / rate_hz
            passed = 1.0 - (np.sin(width * half) / (width * np.sin(half))) ** 2
            slow = np.convolve(high * np.conj(turn), window, "same") / np.maximum(weight, 1e-9)
            found[run] += 2.0 * np.real(slow * turn) / passed
            h += 1
    return found


def _fit_hum(record: Record, time_s: np.ndarray, mains_hz: float, kept: np.ndarray) -> dict[str, float]:
    """Frequency and amplitudes by least squares on the high-passed torque."""
    rate_hz = record.sample_rate_hz
    width = max(round(rate_hz / record.pulse_rate_hz), 2)
    harmonics = [h for h in range(1, HARMONICS + 1) if h * mains_hz <= 0.5 * rate_hz + 1e-6]
    # Smoothing reaches over the edges: rows beside those that are left out would be touched by them.
    kept = np.convolve(~kept, np.ones(4 * width + 1), "same") < 0.5

    def smooth_out(values: np.ndarray) -> np.ndarray:
        box = np.ones(2 * width + 1) / (2 * width + 1)
        return values - np.apply_along_axis(lambda c: np.convolve(np.convolve(c, box, "same"), box, "same"), 0, values)

    target = smooth_out(record.torque_nm)[kept]

    def design(frequency_hz: float) -> np.ndarray:
        turn = 2 * np.pi * frequency_hz * time_s[:, None] * np.array(harmonics)
        return np.concatenate([np.cos(turn), np.sin(turn)], axis=1)

    def remaining(frequency_hz: float) -> tuple[float, np.ndarray]:
        columns = smooth_out(design(frequency_hz))[kept]
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


def block_means(grid: Grid, torque_nm: np.ndarray) -> np.ndarray:
    """Means over intervals, N·m, NaN where there is no sample."""
    total = np.bincount(grid.interval, torque_nm, minlength=grid.size) / np.maximum(grid.count, 1)
    return np.where(grid.count > 0, total, np.nan)


def prepare(record: Record) -> tuple[Grid, Raw]:
    """The record on its grid, hum removed, with its white noise; and what its samples show before any fit.

    Raises
    ------
    BadRecord, NotIdentifiable
        No grid can be made, or nothing happens in the record.
    """
    grid = make_grid(record)
    refuse_stillness(grid)
    raw = inspect(record, grid.start_s)
    return replace(grid, torque_nm=block_means(grid, raw.torque_nm), noise_sd_nm=raw.noise_sd_nm), raw


def refuse_stillness(grid: Grid) -> None:
    """Refuse a record in which nothing happens.

    Raises
    ------
    NotIdentifiable
        Nothing may be fitted, there is no pulse, or the torque never changes.
    """
    if grid.fitted.sum() < LEAST_ROWS:
        raise NotIdentifiable(
            f"only {int(grid.fitted.sum())} pulse intervals may be fitted",
            mend="Give rows of segments other than `validate`.",
        )
    if not np.max(grid.pulse_width_us[grid.fitted]) > 0:
        raise NotIdentifiable("no pulse is in the record", mend="Record a PRBS and a ramp.")
    if not np.ptp(grid.torque_nm[grid.fitted]) > 0:
        raise NotIdentifiable("the torque never changes", mend="Check the load cell and the electrodes.")


def fit_plain(grid: Grid, rows: np.ndarray) -> Fitted:
    """The plain structure fitted, and with it the set-up that all candidates of a record share.

    Knots and stiffness are chosen for the plain structure, then never again.
    """
    return to_fitted(estimate(grid, rows)[0])


def to_fitted(solution: Solution, most: int = 20) -> Fitted:
    """A projected solution as the joint problem's, its noise white and slow, and its parameters polished."""
    setup = setup_of(solution)
    problem = Problem(setup, [])
    size, linear = solution.problem.basis.size, solution.linear
    values = np.zeros(problem.size)
    values[:3] = linear.time_constant_s, linear.damping, linear.delay_s
    parts = setup.begins.size
    values[list(problem.baselines)] = setup.to_muscle(solution.coefficients[size : size + parts])
    values[list(problem.initials)] = setup.sign * solution.coefficients[size + parts :]
    values[problem.coefficients] = setup.sign * solution.coefficients[:size]
    noise = NoiseLevel(max(solution.ar1, 0.0), 0.5, float(np.sqrt(solution.variance)))
    fitted = solve(problem, problem.from_physical(values), noise, most=most)
    values = fitted.physical
    quick_s, slow_s = 0.5 * values[0] / values[1], 2.0 * values[0] * values[1]
    if not most or quick_s > HARDLY_FELT_S:
        return fitted
    values[0] = np.sqrt(QUICK_S * slow_s)
    values[1:3] = 0.5 * (QUICK_S + slow_s) / values[0], 0.0
    theta = np.clip(problem.from_physical(values), problem.lower, problem.upper)
    return max(fitted, solve(problem, theta, noise, most=most), key=lambda found: found.log_evidence)


def setup_of(solution: Solution) -> Setup:
    """What all candidates share: the record as the muscle counts it, and one recruitment curve's prior."""
    problem, grid = solution.problem, solution.problem.grid
    size = problem.basis.size
    curve = problem.basis.design(np.linspace(0.0, problem.basis.largest_us, 101)) @ solution.coefficients[:size]
    sign = 1.0 if curve[np.argmax(np.abs(curve))] >= 0 else -1.0
    zero = float(solution.coefficients[size])
    target = sign * (grid.torque_nm - zero)
    parts = grid.begins.size
    own_zero = sign * (solution.coefficients[size : size + parts][grid.part] - zero)
    smooth = np.convolve(np.where(problem.rows, target - own_zero, 0.0), np.ones(3) / 3, "same")
    scale = float(np.percentile(np.abs(smooth[problem.rows]), 99.5))
    return Setup(
        grid=grid,
        target_nm=target,
        fitted=problem.rows,
        basis=problem.basis,
        roughness=solution.weight / max(solution.variance, 1e-300) * problem.roughness,
        scale_nm=max(scale, 1e-9),
        noise_sd_nm=grid.noise_sd_nm,
        delay_bounds_s=grid.delay_bounds_s if problem.delay_s is None else (problem.delay_s, problem.delay_s),
        zero_nm=zero,
        sign=sign,
        spread=_spread(grid),
        reference_s=_reference(grid, problem.rows),
    )


def _spread(grid: Grid) -> np.ndarray | float:
    """Noise of each interval over the mean noise: each part of a record has its own."""
    parts = grid.begins.size
    if parts == 1:
        return 1.0
    record = grid.record
    kept = grid.counted & ~record.held_out
    parts_sd = [_part_noise(record, record.torque_nm[kept & (record.part == part)]) for part in range(parts)]
    own = np.array(parts_sd)
    known = own[np.isfinite(own)]
    if not known.size:
        return 1.0
    own = np.where(np.isfinite(own), own, known.mean())
    # However quiet a part seems, it is not worth more than a few of another.
    own = np.maximum(own, LEAST_SPREAD * own.max())
    return (own / own.mean())[grid.part]


def _part_noise(record: Record, torque_nm: np.ndarray) -> float:
    """White noise of a sample of one part, not below what its counts leave, N·m; NaN where it has hardly a sample."""
    if torque_nm.size < 16:
        return float("nan")
    step = np.abs(np.diff(torque_nm))
    count = float(np.min(step[step > 0], initial=np.inf))
    return max(white_noise(record, torque_nm), count / np.sqrt(12.0) if np.isfinite(count) else 0.0)


def _reference(grid: Grid, rows: np.ndarray) -> float:
    """Middle of the fitted pulses that recruit in part, s; of all pulses where there is none."""
    width = grid.pulse_width_us
    partly = rows & (width > 0) & (width < 0.97 * width.max())
    at = np.flatnonzero(partly if partly.any() else rows & (width > 0))
    return float(np.mean(at) * grid.step_s) if at.size else 0.0
