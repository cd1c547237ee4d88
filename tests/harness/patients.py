"""Records of simulated patients, for tests and benches."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from stimrig.identify.records.record import Record
from tests.harness.muscle import Patient


def prbs(seconds: float, level_us: float, rng: np.random.Generator) -> np.ndarray:
    n = int(seconds * 40)
    return np.repeat(rng.integers(0, 2, n // 8 + 1), 8)[:n] * level_us


def ramp(seconds: float = 10.0, top_us: float = 300.0) -> np.ndarray:
    n = int(seconds * 40)
    up = np.linspace(0, top_us, n // 2, endpoint=False)
    return np.r_[up, top_us - up]


def multilevel(seconds: float, top_us: float, rng: np.random.Generator) -> np.ndarray:
    n = int(seconds * 40)
    return np.repeat(rng.uniform(0, top_us, n // 20 + 1), 20)[:n]


def protocol(rng: np.random.Generator, top_us: float = 300.0, validate: bool = True) -> tuple[np.ndarray, list[str]]:
    """rest, prbs, rest, ramp, rest (, validate, rest): widths and a name for each pulse."""
    parts = [
        ("rest", np.zeros(40)),
        ("prbs", prbs(15, top_us, rng)),
        ("rest", np.zeros(80)),
        ("ramp", ramp(10, top_us)),
        ("rest", np.zeros(80)),
    ]
    if validate:
        parts += [("validate", multilevel(13, top_us, rng)), ("rest", np.zeros(40))]
    return np.concatenate([p for _, p in parts]), [name for name, p in parts for _ in p]


def as_record(
    torque_nm: np.ndarray, widths_us: np.ndarray, rate_hz: float, names: list[str] | None = None, start_s: float = 0.0
) -> Record:
    """The record of a torque; with a width, and a segment, for each pulse."""
    slot = np.minimum((np.arange(torque_nm.size) * 40 / rate_hz + 1e-9).astype(int), widths_us.size - 1)
    segments = None if names is None else np.array(names)[slot]
    return Record.from_arrays(start_s + np.arange(torque_nm.size) / rate_hz, widths_us[slot], torque_nm, segments)


def make_record(
    patient: Patient,
    rng: np.random.Generator,
    *,
    rate_hz: float = 400.0,
    noise_nm: float = 0.05,
    ar1: float = 0.0,
    validate: bool = True,
    baseline_nm: float = 0.0,
    pulses: tuple[np.ndarray, list[str]] | None = None,
) -> tuple[Record, np.ndarray]:
    """A record and its clean torque; `pulses`: a width and a segment for each pulse, drawn if None."""
    widths, names = pulses or protocol(rng, validate=validate)
    clean = patient.torque(widths, rate_hz) + baseline_nm
    noise = rng.standard_normal(clean.size) * noise_nm
    if ar1:
        noise = lfilter([np.sqrt(1 - ar1**2)], [1, -ar1], noise)
    return as_record(clean + noise, widths, rate_hz, names), clean
