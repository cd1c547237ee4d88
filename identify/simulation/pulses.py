"""What a list of pulses gives: free run from rest, for whoever plans a trial."""

from __future__ import annotations

import numpy as np

from identify.records.record import Record
from identify.simulation.predict import Muscle, predict

REST_S = 1.0
SAMPLES_A_PULSE = 8


def above_rest(model: Muscle, pulse_width_us: np.ndarray, pulse_rate_hz: float) -> np.ndarray:
    """Mean torque in each pulse's period, N·m, after one second of rest, effects included; shape (K,).

    What the same model gives without any pulse is taken off: voluntary effort, tremor, hum and drift of the day of the
    test are no answer to a stimulus, and won't be there again.

    Parameters
    ----------
    model : Muscle
        The model.
    pulse_width_us : ndarray, shape (K,)
        One for each pulse, µs.
    pulse_rate_hz : float
        Pulses per second.

    Raises
    ------
    BadModel
        As `predict`.
    """
    rest = round(REST_S * pulse_rate_hz)

    def torque_of(widths_us: np.ndarray) -> np.ndarray:
        held = np.repeat(np.r_[np.zeros(rest), widths_us], SAMPLES_A_PULSE)
        time_s = np.arange(held.size) / (SAMPLES_A_PULSE * pulse_rate_hz)
        record = Record.from_arrays(time_s, held, np.zeros(held.size), pulse_rate_hz=pulse_rate_hz)
        return predict(model, record).reshape(-1, SAMPLES_A_PULSE).mean(axis=1)[rest:]

    widths = np.asarray(pulse_width_us, float)
    return torque_of(widths) - torque_of(np.zeros(widths.size))
