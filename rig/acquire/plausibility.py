"""Detects torque that neither an arm nor a working load cell can give: a jump, a stuck value, a wrong sample rate.

A sign that is reversed while the torque is near zero cannot be detected here; the identification detects it.

A saturated amplifier is not a dead cell. Its value is the largest or smallest of the test, far from the first one, and
the torque has left this value and returned to exactly the same one. Saturation may last longer than a stuck value, so
that the identification can report clipping. It must still end soon: torque beyond the range is not seen, so no torque
limit can act.
"""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.stream import LOOK_AT, steps_from
from stimrig.rig.align import RATE_TOLERANCE

RATE_WINDOW_S = 3.0
"""Real seconds over which the rate is measured, between the least delayed blocks of the first and last third."""
JITTER_S = 0.06
"""At the test's end: delay that even the least delayed block of a third may have; at least the longest standstill."""
STANDSTILL_S = 0.3
"""After a longer standstill of host or line a third of the window may hold only late blocks: start again."""
BIN_S = 0.1
"""Rig seconds per bin; the least delayed block of each bin is kept for the rate."""


class RateCheck:
    """The rate of one test's samples, however irregularly they are read; for cells and angle sensors alike."""

    def __init__(self, name: str, rate_hz: float, speed: float) -> None:
        self._name, self._rate_hz = name, rate_hz
        self._window_s, self._jitter_s, self._standstill_s = (
            real_s * speed for real_s in (RATE_WINDOW_S, JITTER_S, STANDSTILL_S)
        )
        self._longest_s = 0.0
        self._last_s: float | None = None
        self._count = 0
        self._restarted = False
        self._from_s: float | None = None
        self._prompt: list[tuple[float, int]] = []

    def begin(self) -> None:
        """Start the measurement again, since an old backlog may have been read. From any thread."""
        self._restarted = True

    def fault(self, count: int, number: int, now_s: float) -> str | None:
        """Return the fault of the rate in words, or None.

        `count`, `number`: of samples in this block; of its last sample, -1 if the device counts none. `now_s`: when the
        block arrived.
        """
        if self._restarted:
            self._restarted, self._from_s, self._prompt = False, None, []
        self._count += count
        self._keep_promptest(now_s, number if number >= 0 else self._count)
        from_s, third_s = self._counted_from(count, now_s), self._window_s / 3
        self._last_s = now_s
        if now_s - from_s < self._window_s:
            return None
        begin_s = now_s - self._window_s
        rate_hz = self._rate((begin_s, begin_s + third_s), (now_s - third_s, now_s))
        if rate_hz is None or abs(rate_hz / self._rate_hz - 1) <= RATE_TOLERANCE:
            return None
        return self._message(rate_hz)

    def fault_at_end(self) -> str | None:
        """Compare the rate over the whole test with the rig file's; None: they agree, or there were too few samples.

        `fault` cannot measure the rate in a test shorter than its window, or between frequent long standstills.
        The tolerance allows for the error that the longest standstill can cause.
        """
        if len(self._prompt) < 3:
            return None
        begin_s, end_s = self._prompt[0][0], self._prompt[-1][0]
        third_s = (end_s - begin_s) / 3
        rate_hz = self._rate((begin_s, begin_s + third_s), (end_s - third_s, end_s))
        tolerance = RATE_TOLERANCE + max(self._jitter_s, self._longest_s) / (end_s - begin_s)
        if rate_hz is None or abs(rate_hz / self._rate_hz - 1) <= tolerance:
            return None
        return self._message(rate_hz)

    def _counted_from(self, count: int, now_s: float) -> float:
        """Start of the rate measurement: after a standstill, when the backlog has been read."""
        gap_s = 0.0 if self._last_s is None else now_s - self._last_s
        behind_s = gap_s - count / self._rate_hz
        self._longest_s = max(self._longest_s, behind_s)
        if self._from_s is None:
            self._from_s = now_s
        elif behind_s > self._standstill_s:
            self._from_s = max(self._from_s + gap_s, now_s) + behind_s
        return self._from_s

    def _rate(self, early: tuple[float, float], late: tuple[float, float]) -> float | None:
        """Samples per second between the least delayed blocks of two time spans, s; None if one span has no block."""
        first, last = self._promptest(*early), self._promptest(*late)
        if first is None or last is None or last[0] <= first[0]:
            return None
        return (last[1] - first[1]) / (last[0] - first[0])

    def _delay_s(self, block: tuple[float, int]) -> float:
        """Delay of a block, up to a constant, if the rate is nominal."""
        return block[0] - block[1] / self._rate_hz

    def _promptest(self, from_s: float, to_s: float) -> tuple[float, int] | None:
        """The block with the least delay in a time span; blocks of a backlog or of a busy host have more."""
        low, high = bisect_left(self._prompt, (from_s, 0)), bisect_right(self._prompt, (to_s, sys.maxsize))
        return min(self._prompt[low:high], key=self._delay_s, default=None)

    def _keep_promptest(self, now_s: float, number: int) -> None:
        earliest = self._prompt
        if not earliest or int(earliest[-1][0] / BIN_S) != int(now_s / BIN_S):
            earliest.append((now_s, number))
        elif self._delay_s((now_s, number)) < self._delay_s(earliest[-1]):
            earliest[-1] = now_s, number

    def _message(self, rate_hz: float) -> str:
        return (
            f"{self._name}: {rate_hz:.0f} samples/s arrive, the rig file says {self._rate_hz:g}; check settings and bus"
        )


FASTEST_NM_S = 1000.0
RAIL_VISITS = 2
"""Visits of an extreme value before it counts as saturation: a failing cell reaches its last value once."""
RAIL_LEAST_NM = 0.5
"""Smallest distance of a saturation value from the test's first torque. At rest a coarse converter gives two or three
values and returns to the smallest again and again; a cell that fails there is not saturated."""


class PlausibilityCheck:
    """Checks the samples of one test, block by block.

    `jump_nm`: largest change from one sample to the next. `stuck_s`, `clipped_s`: how long, in rig seconds, a cell that
    had noise before may repeat exactly the same value, and a saturated amplifier its own. `noisy`: how often the value
    changed shortly before the test, so that a cell that is stuck from the start is found.
    """

    def __init__(
        self, jump_nm: float, stuck_s: float, clipped_s: float, rate_hz: float, speed: float, noisy: int = 0
    ) -> None:
        self._jump_nm, self._stuck_s, self._clipped_s = jump_nm, stuck_s, clipped_s
        self._rails = _Rail(1), _Rail(-1)
        self._first_nm: float | None = None
        self.rate = RateCheck("load cell", rate_hz, speed)
        self._last: tuple[float, float] | None = None
        self._noisy = noisy
        self._same_since_s: float | None = None

    def fault(self, samples: NDArray[Any]) -> str | None:
        """Return the fault of this block in words, or None."""
        torque_nm, now_s = samples["torque_nm"], float(samples["host_time_s"][-1])
        fault = self._jumped(torque_nm, now_s) or self._stuck(torque_nm, now_s)
        fault = fault or self.rate.fault(len(samples), int(samples["counter"][-1]), now_s)
        self._last = float(torque_nm[-1]), now_s
        return fault

    def _jumped(self, torque_nm: NDArray[np.float64], now_s: float) -> str | None:
        before_nm, before_s = self._last or (float(torque_nm[0]), now_s)
        steps_nm = np.abs(steps_from(before_nm, torque_nm))
        steps_nm[0] -= FASTEST_NM_S * max(0.0, now_s - before_s - 0.02)  # during a gap it may change a lot
        worst_nm = float(steps_nm.max())
        if worst_nm <= self._jump_nm or np.isnan(worst_nm):  # NaN is reported elsewhere
            return None
        return (
            f"load cell: torque_jump_nm {worst_nm:.2f} N·m from one sample to the next is outside "
            f"0 … {self._jump_nm:g}: a knock, a loose cable, or a reversed sign"
        )

    def _stuck(self, torque_nm: NDArray[np.float64], now_s: float) -> str | None:
        before_nm = self._last[0] if self._last else float(torque_nm[0])
        self._first_nm = before_nm if self._first_nm is None else self._first_nm
        at_rail = [rail.contains(torque_nm, before_nm) for rail in self._rails]
        at_end = any(at_rail) and abs(torque_nm[-1] - self._first_nm) >= RAIL_LEAST_NM
        if not (torque_nm == before_nm).all():
            self._noisy += 1
            self._same_since_s = None
            return None
        if self._same_since_s is None:
            self._same_since_s = now_s
        stood_s = now_s - self._same_since_s
        allowed_s = self._clipped_s if at_end else self._stuck_s
        if self._noisy < 3 or stood_s < allowed_s:  # a cell without noise may repeat a value
            return None
        text = f"load cell: its value has stayed at exactly {torque_nm[0]:.3f} N·m"
        if at_end:
            return f"{text}, the end of its range, for too long: higher torque is not seen; widen it or stimulate less"
        return f"{text}; it is stuck: check its amplifier, and {LOOK_AT}"


class _Rail:
    """The largest value that a cell has given (smallest with sign -1), and how often it reached exactly this value."""

    def __init__(self, sign: int) -> None:
        self._sign, self._end_nm, self._visits = sign, -np.inf, 0

    def contains(self, torque_nm: NDArray[np.float64], before_nm: float) -> bool:
        """Return whether the last of these samples may be saturated."""
        signed_nm = self._sign * np.concatenate(((before_nm,), torque_nm))
        most_nm = float(signed_nm.max())
        if most_nm > self._end_nm:
            self._end_nm, self._visits = most_nm, 0
        there = signed_nm == self._end_nm
        self._visits += int(np.count_nonzero(there[1:] & ~there[:-1]))
        return bool(there[-1]) and self._visits >= RAIL_VISITS
