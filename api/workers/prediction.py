"""What a model says a list of pulse widths would give: for a controller that plans a trial. Run in a worker."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

REST_S = 1.0
SAMPLES_A_PULSE = 8


def forecast(
    progress: Callable[[float, str], None], model_json: str, pulse_width_us: list[float], pulse_rate_hz: float = 40.0
) -> dict[str, Any]:
    """Mean torque that the pulses give in each pulse's period, N·m, effects included, after one second of rest.

    What the same model gives without any pulse is taken off: voluntary effort, tremor, hum and drift of the day of the
    test are no answer to a stimulus, and won't be there again.
    """
    import numpy as np

    import identify

    progress(0.1, "predicting")
    model = identify.Model.from_json(model_json)
    rest = round(REST_S * pulse_rate_hz)

    def torque_of(widths_us: np.ndarray) -> np.ndarray:
        held = np.repeat(np.r_[np.zeros(rest), widths_us], SAMPLES_A_PULSE)
        time_s = np.arange(held.size) / (SAMPLES_A_PULSE * pulse_rate_hz)
        record = identify.Record.from_arrays(time_s, held, np.zeros(held.size), pulse_rate_hz=pulse_rate_hz)
        return np.asarray(identify.predict(model, record)).reshape(-1, SAMPLES_A_PULSE).mean(axis=1)[rest:]

    widths = np.asarray(pulse_width_us, float)
    return {"torque_nm": (torque_of(widths) - torque_of(np.zeros(widths.size))).round(6).tolist()}
