"""A record of two muscles at one joint, made of the plainest equations, for tests of what reads and fits it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter

from stimrig.identify.muscles import Channel, JointRecord

FINE_HZ, RATE_HZ, PULSES_HZ, LARGEST_US = 1600, 400, 40, 300.0
OFFSET_S = 0.5 / PULSES_HZ
NAMES = ("biceps", "triceps")


def make(
    seed: int = 0, cross_talk: float = 0.0, stiffer: float = 0.0, noise_nm: float = 0.05, zero_nm: float = 0.7
) -> tuple[JointRecord, np.ndarray, dict[str, np.ndarray]]:
    """The record, its torque without noise, and each muscle's own; cross-talk goes from the first to the second."""
    rng = np.random.default_rng(seed)
    widths, segment_s = _widths(rng)
    fine = {name: np.repeat(one, FINE_HZ // PULSES_HZ) for name, one in zip(NAMES, widths, strict=True)}
    late = round(OFFSET_S * FINE_HZ)
    fine[NAMES[1]] = np.r_[np.zeros(late), fine[NAMES[1]][:-late]]
    largest = rng.uniform(4.0, 12.0, 2)
    drives = [sigmoid(one, rng.uniform(100, 180), rng.uniform(12, 30)) for one in fine.values()]
    reached = cross_talk * np.clip((fine[NAMES[0]] / LARGEST_US - 0.45) / 0.55, 0.0, 1.0)
    drives[1] = drives[1] + reached * (1.0 - drives[1])
    up, down = (respond(one, rng.uniform(0.1, 0.35)) for one in drives)
    loss = 1.0 + stiffer * (up + 0.6 * down)
    own = largest[0] * up, -largest[1] * down
    torque = (own[0] + own[1]) / loss + zero_nm
    step = FINE_HZ // RATE_HZ
    time_s = np.arange(torque[::step].size) / RATE_HZ
    true_nm = torque[::step]
    segment = np.array(["rest", "prbs", "ramp", "validate"])[np.searchsorted(segment_s, time_s, side="right")]
    record = JointRecord.from_arrays(
        [Channel(NAMES[0]), Channel(NAMES[1], offset_s=OFFSET_S)],
        time_s,
        {name: one[::step] for name, one in fine.items()},
        true_nm + noise_nm * rng.standard_normal(true_nm.size),
        segment,
    )
    return record, true_nm, {name: one[::step] for name, one in zip(NAMES, own, strict=True)}


def _widths(rng: np.random.Generator) -> tuple[list[np.ndarray], list[float]]:
    """Random levels of both, a ramp of each and of both, levels held out; with when the segments end, s."""
    size = 48 * PULSES_HZ
    found = []
    for ramps_s in ((25.0, 37.0), (31.0, 38.0)):
        widths = np.zeros(size)
        for begin_s, end_s in ((2.0, 23.0), (43.5, 47.0)):
            at = round(begin_s * PULSES_HZ)
            while at < end_s * PULSES_HZ:
                held = int(rng.integers(8, 40))
                widths[at : min(at + held, round(end_s * PULSES_HZ))] = rng.choice([0.0, rng.uniform(80, 300), 300.0])
                at += held
        for begin_s in ramps_s:
            at, up = round(begin_s * PULSES_HZ), 2 * PULSES_HZ
            widths[at : at + 2 * up] = LARGEST_US * np.r_[np.arange(1, up + 1), np.arange(up - 1, -1, -1)] / up
        found.append(widths)
    return found, [2.0, 24.5, 43.0]


def sigmoid(width_us: np.ndarray, middle_us: float, steep_us: float) -> np.ndarray:
    low = 1.0 / (1.0 + np.exp(middle_us / steep_us))
    return np.clip(1.0 / (1.0 + np.exp(-(width_us - middle_us) / steep_us)) - low, 0.0, None) / (1.0 - low)


def respond(drive: np.ndarray, period_s: float) -> np.ndarray:
    system: Any = cont2discrete(([1.0], [period_s**2, 1.8 * period_s, 1.0]), 1.0 / FINE_HZ)
    return np.asarray(lfilter(np.ravel(system[0]), np.ravel(system[1]), drive))


def written(record: JointRecord) -> str:
    """The record as a CSV table, each channel's widths when they came."""
    first, second = (one.pulse_width_us for one in record.records)
    late = round(OFFSET_S * RATE_HZ)
    second = np.r_[np.zeros(late), second[:-late]]
    one = record.records[0]
    rows = [f"time_s,{NAMES[0]}_pulse_width_us,{NAMES[1]}_pulse_width_us,torque_nm,segment"]
    names = [one.segment_names[code] for code in one.segment]
    columns = zip(one.time_s, first, second, one.torque_nm, names, strict=True)
    rows += [f"{t:.5f},{a:.4f},{b:.4f},{nm:.6f},{name}" for t, a, b, nm, name in columns]
    return "\n".join(rows) + "\n"
