"""The torque receiver: a stream that records while a test runs.

It reports at once a torque outside its limit or one that is not a number.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.stream import LOOK_AT, SETTLE_S, SETTLING_S, Stream
from stimrig.rig.devices import Sensor
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


class Stillness:
    """Judges whether an exactly constant value is odd for this cell: a bridge without its plug gives a constant.

    A coarse cell of a limb at rest is constant, too. It was so before, so it is not odd.
    """

    def __init__(self) -> None:
        self.since_s: float | None = None
        """When it began to stand, rig time; None: it changes."""
        self.ever_changed = False
        self._changed: deque[bool] = deque(maxlen=200)
        """Changes of the newest blocks; of each standstill only the beginning."""

    @property
    def restless(self) -> bool:
        """True where most blocks before this standstill brought a change."""
        return 2 * sum(self._changed) > len(self._changed)

    def add(self, changes: bool, now_s: float, brief_s: float) -> None:
        """A block of samples; `brief_s`: of how much of a standstill the blocks count, rig seconds."""
        self.ever_changed |= changes
        self.since_s = None if changes else now_s if self.since_s is None else self.since_s
        if self.since_s is None or now_s - self.since_s <= brief_s:
            self._changed.append(changes)


LIVE_BLOCKS = 4000
FRESH_S = 0.5
"""Real seconds to wait for a new torque sample before arming."""
LATEST_S = 0.1
"""Age of the newest sample before the first pulse, real seconds, also where the rig file allows more in a test."""
RANGE_MEAN_S = 0.01
"""Seconds of torque of which one mean counts for the range: less noise than in single samples."""


class Receiver(Stream):
    """The load cell's."""

    def __init__(self, cell: Sensor, tasks: Tasks, on_lost: Callable[[str], None]) -> None:
        super().__init__("load cell", cell, tasks, on_lost)
        self._limits_nm = (-np.inf, np.inf)
        self.last_torque_nm: float | None = None
        self.peak_nm = 0.0
        self.range_nm = (np.inf, -np.inf)
        self.torque_time = TorqueTime()
        self._unaveraged_nm = np.empty(0)
        self.live: deque[NDArray[Any]] = deque(maxlen=LIVE_BLOCKS)
        self.recent: deque[tuple[float, float]] = deque(maxlen=400)
        self._stillness = Stillness()
        self._opened_s = self._clock.now_s()

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
        """Count the torque's changes from block to block during the last one or two seconds."""
        means_nm = [torque for _, torque in tuple(self.recent)]
        return int(np.sum(np.abs(np.diff(means_nm)) > 1e-9))  # means of equal samples differ by rounding

    def suspicion(self, stuck_s: float, unmoved_s: float) -> tuple[str, float] | None:
        """Return why no pulse may come yet, and for how many real seconds that may be waited for; None: nothing is odd.

        What arrives may not be the torque of now. `stuck_s`, `unmoved_s`: of `Watch`: how long a restless cell may
        stand still, and one that never gave another value; real seconds.
        """
        now_s, speed, still = self._clock.now_s(), self._clock.speed, self._stillness
        age_s = self.age_s(now_s) / speed
        if not math.isfinite(age_s):
            return f"no torque has come from the load cell on {self._place} yet: {LOOK_AT}", FRESH_S
        if not (age_s <= LATEST_S):
            return f"no torque from the load cell on {self._place} for {age_s:.1f} s: {LOOK_AT}", FRESH_S
        same_nm, stood_s = self.last_torque_nm, (now_s - (still.since_s or self._opened_s)) / speed
        if not still.ever_changed and stood_s > unmoved_s:
            return (
                f"the load cell on {self._place} has given exactly {same_nm:.3f} N·m since it was connected: pull at "
                f"it, the value must follow; if not, {LOOK_AT}"
            ), 0.0
        if still.restless and still.since_s is not None and stood_s > SETTLING_S:
            words = f"the load cell on {self._place} has given exactly {same_nm:.3f} N·m for {stood_s:.1f} s: {LOOK_AT}"
            return words, 0.0 if stood_s >= stuck_s else math.inf
        if now_s - self.error_s <= SETTLING_S * speed:
            return f"the adapter of the load cell on {self._place} reports errors of the bus: {LOOK_AT}", SETTLE_S
        return None

    def _store(self, samples: NDArray[Any]) -> None:
        self._remember(samples)
        self._write(Kind.TORQUE, samples)
        self._check_limits(samples["torque_nm"])
        self._check(samples)

    def _remember(self, samples: NDArray[Any]) -> None:
        now_s, mean_nm = float(samples["host_time_s"][-1]), float(samples["torque_nm"].mean())
        before_nm = samples["torque_nm"][0] if self.last_torque_nm is None else self.last_torque_nm
        changes = bool((samples["torque_nm"] != before_nm).any())
        self._stillness.add(changes, now_s, SETTLING_S * self._clock.speed)
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
