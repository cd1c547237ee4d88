"""Measures at which rate samples arrive, however irregularly they are read; for cells and angle sensors alike."""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right

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
    """The rate of one test's samples.

    Parameters
    ----------
    name
        Of the device, for messages.
    rate_hz
        Nominal.
    speed
        Rig seconds per real second.
    """

    def __init__(self, name: str, rate_hz: float, speed: float) -> None:
        self._name, self._rate_hz = name, rate_hz
        self._window_s, self._jitter_s, self._standstill_s = (
            real_s * speed for real_s in (RATE_WINDOW_S, JITTER_S, STANDSTILL_S)
        )
        self._longest_s = 0.0
        self._last_s: float | None = None
        self._count = 0
        self._anew = False
        self._from_s: float | None = None
        self._prompt: list[tuple[float, int]] = []

    def begin(self) -> None:
        """Start the measurement again, since an old backlog may have been read. From any thread."""
        self._anew = True

    def fault(self, count: int, number: int, now_s: float) -> str | None:
        """What is wrong with the rate; None: nothing.

        Parameters
        ----------
        count, number
            Of samples in this block; of its last sample, -1 if the device counts none.
        now_s
            When the block arrived.
        """
        if self._anew:
            self._anew, self._from_s, self._prompt = False, None, []
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
        """Whether the rate over the whole test differs from the rig file's; None: no, or there were too few samples.

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
        kept = self._prompt
        if not kept or int(kept[-1][0] / BIN_S) != int(now_s / BIN_S):
            kept.append((now_s, number))
        elif self._delay_s((now_s, number)) < self._delay_s(kept[-1]):
            kept[-1] = now_s, number

    def _message(self, rate_hz: float) -> str:
        return (
            f"{self._name}: {rate_hz:.0f} samples/s arrive, the rig file says {self._rate_hz:g}; check settings and bus"
        )
