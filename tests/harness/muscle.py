"""The simulated muscle of tests and benches: sigmoid recruitment, second-order dynamics, delay, finely stepped.

Written apart from `identify` and `hardware_sim`, with scipy's discretisation, so that neither is tested against itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

FINE_HZ = 8000


def sigmoid(width_us: np.ndarray, gain_nm: float, a2: float, a3: float) -> np.ndarray:
    """The paper's recruitment curve, eq. (35), N·m; `a2` per µs."""
    decay = np.exp(-a2 * np.asarray(width_us, float))
    return gain_nm * (1 - decay) / (1 + a3 * decay)


def second_order(drive_nm: np.ndarray, time_constant_s: float, damping: float, rate_hz: float) -> np.ndarray:
    """Torque from rest for a drive that is held over each sample, N·m, shape as `drive_nm`."""
    transfer = ([1.0], [time_constant_s**2, 2 * damping * time_constant_s, 1.0])
    b, a = cont2discrete(transfer, 1 / rate_hz, method="zoh")[:2]
    return np.asarray(lfilter(np.ravel(b), np.ravel(a), drive_nm))


def torque_after(
    drive_nm: np.ndarray,
    rate_hz: float,
    time_constant_s: float,
    damping: float,
    delay_s: float = 0.0,
    pulse_rate_hz: float = 40.0,
) -> np.ndarray:
    """Clean torque from rest, sampled at `rate_hz`, of one recruited torque a pulse that comes after a delay, N·m."""
    fine = np.repeat(drive_nm, round(FINE_HZ / pulse_rate_hz))
    late = round(delay_s * FINE_HZ)
    torque = second_order(np.r_[np.zeros(late), fine][: fine.size], time_constant_s, damping, FINE_HZ)
    at = np.arange(round(drive_nm.size / pulse_rate_hz * rate_hz)) * FINE_HZ / rate_hz
    return torque[np.round(at).astype(int)]


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
        drive_nm = self.recruitment(widths_us)
        return torque_after(drive_nm, rate_hz, self.time_constant_s, self.damping, self.delay_s, pulse_rate_hz)
