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
    """Elbow torque of `muscle`, driven by the pulses given, without the sensor's noise.

    Parameters
    ----------
    muscle : Muscle
        Its time not yet beyond `begin_s`.
    pulse_times_s, widths_us : array_like, shape (P,)
        When each pulse arrives, rising, and its width a phase. A width of 0 is no pulse.
    current_ma : float
        Current of every pulse.
    rate_hz : float
        Samples per second of the record.
    duration_s : float
        Length of the record.
    begin_s : float
        Time of its first sample: a session is simulated stretch by stretch, on one clock.

    Returns
    -------
    ndarray, shape (N,)
        Torque in N·m at the times begin_s + n / rate_hz, n = 0 … N - 1, N = round(duration_s · rate_hz).

    Raises
    ------
    ValueError
        Times and widths differ in number, or times do not rise.
    """
    times = np.asarray(pulse_times_s, dtype=float)
    widths = np.asarray(widths_us, dtype=float)
    if times.ndim != 1 or times.shape != widths.shape:
        raise ValueError(f"pulse times {times.shape} and widths {widths.shape} must be two equally long rows")
    if times.size > 1 and not np.all(np.diff(times) > 0):
        raise ValueError("pulse times must rise from each pulse to the next")
    fired = widths > 0
    pulses = list(zip(times[fired].tolist(), widths[fired].tolist(), strict=True))
    sample_count = round(duration_s * rate_hz)
    torque_nm = np.empty(sample_count)
    next_pulse = 0
    for n in range(sample_count):
        time_s = begin_s + n / rate_hz
        while next_pulse < len(pulses) and pulses[next_pulse][0] <= time_s:
            muscle.pulse(*pulses[next_pulse], current_ma)
            next_pulse += 1
        torque_nm[n] = muscle.torque_nm(time_s)
    return torque_nm
