"""Simulated patients for tests and benches: sigmoid recruitment, second-order dynamics, delay, finely stepped.

Written apart from `identify` and `hardware_sim`, with scipy's discretisation, so that neither is tested against itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from identify.records.record import Record

FINE_HZ = 8000


def sigmoid(width_us: np.ndarray, gain_nm: float, a2: float, a3: float) -> np.ndarray:
    """The paper's recruitment curve, eq. (35), N·m; `a2` per µs."""
    decay = np.exp(-a2 * np.asarray(width_us, float))
    return gain_nm * (1 - decay) / (1 + a3 * decay)


def second_order(drive_nm: np.ndarray, time_constant_s: float, damping: float, rate_hz: float) -> np.ndarray:
    """Torque from rest for a drive that is held over each sample, N·m, shape as `drive_nm`."""
    transfer = ([1.0], [time_constant_s**2, 2 * damping * time_constant_s, 1.0])
    b, a = cont2discrete(transfer, 1 / rate_hz, method="zoh")[:2]  # pyright: ignore
    return np.asarray(lfilter(np.ravel(b), np.ravel(a), drive_nm))


@dataclass(frozen=True)
class Patient:
    """The paper's muscle unless told otherwise; `gain` in N·m, `a2` per µs."""

    gain: float = 6.8994
    a2: float = 0.0410
    a3: float = 2389.7
    time_constant_s: float = 0.5284
    damping: float = 0.6369
    delay_s: float = 0.0

    @classmethod
    def with_rise(cls, rise_us: float, middle_us: float, **others: float) -> Patient:
        """A patient whose recruitment rises from 10 to 90 % over `rise_us`, about `middle_us`."""
        a2 = 4.4 / rise_us
        return cls(a2=a2, a3=float(np.exp(min(a2 * middle_us, 600.0))), **others)

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Patient:
        """Gain 1.5-15 N·m, rise 10-150 µs, middle 40-200 µs, T 0.1-0.6 s, damping 0.6-1.2, delay 0-60 ms."""
        gain = float(rng.uniform(1.5, 15.0))
        rise_us = float(np.exp(rng.uniform(np.log(10.0), np.log(150.0))))
        middle_us = float(rng.uniform(40.0, 200.0))
        time_constant_s, damping = float(rng.uniform(0.1, 0.6)), float(rng.uniform(0.6, 1.2))
        delay_s = float(rng.uniform(0.0, 0.06))
        return cls.with_rise(
            rise_us, middle_us, gain=gain, time_constant_s=time_constant_s, damping=damping, delay_s=delay_s
        )

    def recruitment(self, width_us: np.ndarray) -> np.ndarray:
        """Steady torque, N·m."""
        return sigmoid(width_us, self.gain, self.a2, self.a3)

    def torque(self, widths_us: np.ndarray, rate_hz: float, pulse_rate_hz: float = 40.0) -> np.ndarray:
        """Clean torque sampled at rate_hz for one width a pulse."""
        fine = round(FINE_HZ / pulse_rate_hz)
        drive = np.repeat(self.recruitment(widths_us), fine)
        late = round(self.delay_s * FINE_HZ)
        drive = np.r_[np.zeros(late), drive][: drive.size]
        torque = second_order(drive, self.time_constant_s, self.damping, FINE_HZ)
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
