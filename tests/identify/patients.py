"""Simulated patients for the tests of `identify`, written apart from `identify.dynamics`: scipy's state space, finely
stepped, so that no test marks its own homework."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from identify.records.record import Record

FINE_HZ = 8000


@dataclass(frozen=True)
class Patient:
    """Sigmoid (30) or any other curve, second order, delay."""

    gain: float = 6.8994
    a2: float = 0.0410
    a3: float = 2389.7
    time_constant_s: float = 0.5284
    damping: float = 0.6369
    delay_s: float = 0.0

    def recruitment(self, width_us: np.ndarray) -> np.ndarray:
        decay = np.exp(-self.a2 * np.asarray(width_us, float))
        return self.gain * (1 - decay) / (1 + self.a3 * decay)

    def torque(self, widths_us: np.ndarray, rate_hz: float, pulse_rate_hz: float = 40.0) -> np.ndarray:
        """Clean torque sampled at rate_hz for one width a pulse."""
        fine = round(FINE_HZ / pulse_rate_hz)
        drive = np.repeat(self.recruitment(widths_us), fine)
        late = round(self.delay_s * FINE_HZ)
        drive = np.r_[np.zeros(late), drive][: drive.size]
        t, z = self.time_constant_s, self.damping
        b, a = cont2discrete(([1.0], [t * t, 2 * z * t, 1.0]), 1 / FINE_HZ, method="zoh")[:2]  # pyright: ignore
        torque = lfilter(np.ravel(b), np.ravel(a), drive)
        at = np.round(np.arange(round(widths_us.size / pulse_rate_hz * rate_hz)) * FINE_HZ / rate_hz).astype(int)
        return torque[at]


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
) -> tuple[Record, np.ndarray]:
    """A record and its clean torque."""
    widths, names = protocol(rng, top_us, validate)
    clean = patient.torque(widths, rate_hz) + baseline_nm
    n = clean.size
    slot = np.minimum((np.arange(n) * 40 / rate_hz + 1e-9).astype(int), widths.size - 1)
    noise = rng.standard_normal(n) * noise_nm
    if ar1:
        noise = lfilter([np.sqrt(1 - ar1**2)], [1, -ar1], noise)
    record = Record.from_arrays(np.arange(n) / rate_hz, widths[slot], clean + noise, np.array(names)[slot])
    return record, clean
