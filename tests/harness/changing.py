"""A simulated muscle that changes from trial to trial: gain, threshold, speed; and what disturbs a trial."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stimrig.identify.records.record import Record
from tests.harness.muscle import Patient, torque_after
from tests.harness.patients import as_record

PULSE_RATE_HZ = 40.0


@dataclass(frozen=True)
class Changing:
    """A patient whose gain, shift of the threshold (µs) and time scale are functions of the trial's number.

    The number goes on within a trial: halfway through the third one it is 2.5. `added(trial, time_s)` is a torque that
    is no muscle's answer, N·m.
    """

    patient: Patient
    gain: Callable[[float], float] = lambda _trial: 1.0
    shift_us: Callable[[float], float] = lambda _trial: 0.0
    time_scale: Callable[[float], float] = lambda _trial: 1.0
    added: Callable[[int, np.ndarray], np.ndarray] = lambda _trial, time_s: np.zeros(time_s.size)

    def play(
        self,
        widths_us: np.ndarray,
        trial: int,
        rng: np.random.Generator,
        *,
        rate_hz: float = 400.0,
        noise_nm: float = 0.05,
        sign: float = 1.0,
        baseline_nm: float = 0.0,
        start_s: float = 0.0,
    ) -> Record:
        """The record of one trial, from rest."""
        at = trial + np.arange(widths_us.size) / widths_us.size
        moved = np.array([self.shift_us(a) for a in at])
        gain = np.array([self.gain(a) for a in at])
        drive = gain * self.patient.recruitment(np.where(widths_us > 0.0, np.maximum(widths_us - moved, 0.0), 0.0))
        constant_s = self.patient.time_constant_s * self.time_scale(trial + 0.5)
        clean = torque_after(drive, rate_hz, constant_s, self.patient.damping, self.patient.delay_s)
        torque = clean + self.added(trial, np.arange(clean.size) / rate_hz)
        seen = sign * torque + baseline_nm + noise_nm * rng.standard_normal(torque.size)
        return as_record(seen, widths_us, rate_hz, start_s=start_s)


def reach_widths(patient: Patient) -> np.ndarray:
    """Widths of a trial: a second of rest, moves between levels up to 40 % of the plateau, a second of rest."""
    table_us = np.arange(0.0, 301.0)
    levels = 0.4 * np.array([0.0, 0.5, 0.5, 1.0, 1.0, 0.15, 0.15]) * patient.gain
    wanted = np.interp(np.linspace(0.0, 6.0, round(10.0 * PULSE_RATE_HZ)), np.arange(7.0), levels)
    widths = np.round(np.interp(wanted, patient.recruitment(table_us), table_us))
    return np.r_[np.zeros(40), widths, np.zeros(40)]
