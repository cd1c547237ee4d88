"""The protocol of every emulated muscle: pulses in, elbow torque out."""

from __future__ import annotations

from typing import Protocol


class Muscle(Protocol):
    """A muscle with its joint held still, stimulated by single pulses.

    Time is the emulator's own, in seconds, and never runs backwards.
    """

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        ...

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the elbow torque there, N·m, without the sensor's noise."""
        ...
