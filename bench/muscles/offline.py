"""The torque of a muscle offline, without the wire and without waiting."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stimrig.hardware_sim.patients.muscle import Muscle


def simulate(
    muscle: Muscle,
    pulse_times_s: ArrayLike,
    widths_us: ArrayLike,
    current_ma: float,
    rate_hz: float,
    duration_s: float,
    begin_s: float = 0.0,
) -> NDArray[np.float64]:
    """Elbow torque of `muscle`, N·m, from `begin_s` on, without the sensor's noise.

    Pulse times rise; a width of 0 is no pulse. The muscle's time is not yet beyond `begin_s`: a session is simulated
    stretch by stretch, on one clock.
    """
    pairs = zip(np.asarray(pulse_times_s).tolist(), np.asarray(widths_us).tolist(), strict=True)
    pulses = [(time_s, width_us) for time_s, width_us in pairs if width_us > 0]
    torque_nm = np.empty(round(duration_s * rate_hz))
    for n in range(torque_nm.size):
        time_s = begin_s + n / rate_hz
        while pulses and pulses[0][0] <= time_s:
            muscle.pulse(*pulses.pop(0), current_ma)
        torque_nm[n] = muscle.torque_nm(time_s)
    return torque_nm
