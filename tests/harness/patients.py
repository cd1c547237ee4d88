"""Records of simulated patients, for tests and benches."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from stimrig.identify.records.record import Record
from tests.harness.muscle import Patient


def prbs(seconds: float, level_us: float, rng: np.random.Generator, hold: int = 8) -> np.ndarray:
    n = int(seconds * 40)
    return np.repeat(rng.integers(0, 2, n // hold + 1), hold)[:n] * level_us


def ramp(seconds: float = 10.0, top_us: float = 300.0) -> np.ndarray:
    n = int(seconds * 40)
    up = np.linspace(0, top_us, n // 2, endpoint=False)
    return np.r_[up, top_us - up]


def multilevel(seconds: float, top_us: float, rng: np.random.Generator, hold: int = 20) -> np.ndarray:
    n = int(seconds * 40)
    return np.repeat(rng.uniform(0, top_us, n // hold + 1), hold)[:n]


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


def make_record(
    patient: Patient,
    rng: np.random.Generator,
    *,
    rate_hz: float = 400.0,
    noise_nm: float = 0.05,
    ar1: float = 0.0,
    top_us: float = 300.0,
    validate: bool = True,
    baseline_nm: float = 0.0,
    pulses: tuple[np.ndarray, list[str]] | None = None,
) -> tuple[Record, np.ndarray]:
    """A record and its clean torque; `pulses`: a width and a segment for each pulse, drawn if None."""
    widths, names = pulses or protocol(rng, top_us, validate)
    clean = patient.torque(widths, rate_hz) + baseline_nm
    n = clean.size
    slot = np.minimum((np.arange(n) * 40 / rate_hz + 1e-9).astype(int), widths.size - 1)
    noise = rng.standard_normal(n) * noise_nm
    if ar1:
        noise = lfilter([np.sqrt(1 - ar1**2)], [1, -ar1], noise)
    record = Record.from_arrays(np.arange(n) / rate_hz, widths[slot], clean + noise, np.array(names)[slot])
    return record, clean
