"""The torque-time of a running test: torque above rest times time, as the load cell measured it."""

from __future__ import annotations


class TorqueTime:
    """Sums up from block to block. The time between two blocks counts with the later one, lost samples included."""

    def __init__(self) -> None:
        self.nms = 0.0
        """N·m·s since `begin`; of either sign of the torque, so noise makes it larger, never smaller."""
        self._rest_nm: float | None = None
        self._last_s = 0.0

    def begin(self, rest_nm: float, time_s: float) -> None:
        """Count from now on: torque above `rest_nm`, rig time."""
        self.nms, self._rest_nm, self._last_s = 0.0, rest_nm, time_s

    def add(self, time_s: float, mean_nm: float) -> None:
        """A block's last sample and its mean torque."""
        if self._rest_nm is None:
            return
        self.nms += abs(mean_nm - self._rest_nm) * max(0.0, time_s - self._last_s)
        self._last_s = time_s
