"""The torque receiver: a stream that records while a test runs.

It reports at once a torque outside its limit or one that is not a number.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.stream import Stream
from stimrig.rig.devices import LoadCell
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.signals import Recorded
from stimrig.rig.tasks import Tasks


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


LIVE_BLOCKS = 4000
RANGE_MEAN_S = 0.01
"""Seconds of torque of which one mean counts for the range: less noise than in single samples."""


class Receiver(Stream):
    """The load cell's."""

    def __init__(self, cell: LoadCell, tasks: Tasks, on_lost: Callable[[str], None]) -> None:
        super().__init__("load cell", cell, tasks, on_lost)
        self._limits_nm = (-np.inf, np.inf)
        self.last_torque_nm: float | None = None
        self.peak_nm = 0.0
        self.range_nm = (np.inf, -np.inf)
        self.torque_time = TorqueTime()
        self._unaveraged_nm = np.empty(0)
        self.live: deque[NDArray[Any]] = deque(maxlen=LIVE_BLOCKS)
        self.recent: deque[tuple[float, float]] = deque(maxlen=400)

    def record(
        self,
        journal: Journal,
        limits_nm: tuple[float, float],
        on_fault: Callable[[str], None],
        wrong: Callable[[NDArray[Any]], str | None] = lambda _: None,
    ) -> None:
        """From now on write every sample to the journal and check it; faults are reported at once."""
        self.write_to(journal, wrong, on_fault, on_fault)
        self._limits_nm, self.torque_time, self.peak_nm = limits_nm, TorqueTime(), 0.0
        self.begin_range()

    def begin_range(self) -> None:
        """Forget the range until now: the limb may have moved before the first pulse."""
        self.range_nm, self._unaveraged_nm = (np.inf, -np.inf), np.empty(0)

    def release(self) -> Recorded:
        self._limits_nm = (-np.inf, np.inf)
        return super().release()

    def torque_around(self, duration_s: float) -> float | None:
        """Median of the torque over the last `duration_s`, N·m; None if there is none."""
        since_s = self._clock.now_s() - duration_s
        values = [torque for time_s, torque in tuple(self.recent) if time_s >= since_s]
        return float(np.median(values)) if values else None

    def changes_lately(self) -> int:
        """How often the torque changed from block to block during the last one or two seconds."""
        means_nm = [torque for _, torque in tuple(self.recent)]
        return int(np.sum(np.abs(np.diff(means_nm)) > 1e-9))  # means of equal samples differ by rounding

    def _keep(self, samples: NDArray[Any]) -> None:
        self._remember(samples)
        self._write(Kind.TORQUE, samples)
        self._check_limits(samples["torque_nm"])
        self._check(samples)

    def _remember(self, samples: NDArray[Any]) -> None:
        now_s, mean_nm = float(samples["host_time_s"][-1]), float(samples["torque_nm"].mean())
        self.last_torque_nm = float(samples["torque_nm"][-1])
        self.recent.append((now_s, mean_nm))
        self.torque_time.add(now_s, mean_nm)
        self.live.append(samples)

    def _check_limits(self, torque_nm: NDArray[np.float64]) -> None:
        lo, hi = self._limits_nm
        within = (torque_nm >= lo) & (torque_nm <= hi)
        if not within.all():
            worst = float(torque_nm[np.argmin(within)])
            if np.isnan(worst):
                self._on_fault("load cell: sent a torque that is not a number (NaN); check its amplifier")
            else:
                self._on_fault(f"torque {worst:.2f} N·m is outside {lo:g} … {hi:g} N·m")
        elif self._journal is not None:
            self.peak_nm = max(self.peak_nm, float(np.abs(torque_nm).max()))
            self._widen(torque_nm)

    def _widen(self, torque_nm: NDArray[np.float64]) -> None:
        """Widen the range by means over `RANGE_MEAN_S`: however the bus cut the samples into blocks."""
        samples = np.concatenate([self._unaveraged_nm, torque_nm])
        each = max(1, round(RANGE_MEAN_S * self.nominal_rate_hz))
        whole = len(samples) // each * each
        self._unaveraged_nm = samples[whole:]
        if whole:
            means_nm = samples[:whole].reshape(-1, each).mean(axis=1)
            lo_nm, hi_nm = self.range_nm
            self.range_nm = min(lo_nm, float(means_nm.min())), max(hi_nm, float(means_nm.max()))
