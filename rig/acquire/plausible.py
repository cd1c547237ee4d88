"""Torque that no arm and no sound cell can give: a jump, a value that stands still, a rate that is another.

A sign that was turned while the torque was near zero cannot be told from a muscle here; the identification sees it.

An amplifier at its end is not a dead cell: its value is the most, or the least, of the test, far from the first one,
and the torque has left it and come back to that very number. It may stand there longer, so that the identification can
say that it clips, but not for long: torque beyond it is not seen, and no limit can hold.
"""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

RATE_WINDOW_S = 3.0
"""Real seconds over which the rate is taken, between the promptest blocks of its first and last third."""
RATE_TOLERANCE = 0.035
JITTER_S = 0.06
"""At the test's end: how late even the promptest block of a third may be, or as late as the longest standstill."""
STANDSTILL_S = 0.3
"""After a longer standstill of host or line a third of the window may hold late blocks alone: begin anew."""
BIN_S = 0.1
"""Rig seconds of which the promptest block is kept for the rate."""
FASTEST_NM_S = 1000.0
RAIL_VISITS = 2
"""How often a value must have been come to until it is an amplifier's end: a dying cell comes to its last one once."""
RAIL_LEAST_NM = 0.5
"""How far from the test's first torque an amplifier's end is, at least: at rest a coarse converter gives two or three
values, of which the least comes again and again, and a cell that dies there is no clipped one."""


class Plausible:
    """Judges the samples of one test, block by block.

    Parameters
    ----------
    jump_nm
        Largest change from one sample to the next.
    stuck_s
        How long, in rig seconds, exactly the same value may stand in a cell that had noise before.
    clipped_s
        The same at the amplifier's end.
    rate_hz
        Nominal.
    speed
        Rig seconds a real second.
    noisy
        How often the value changed shortly before the test: a cell that is stuck from its start on had noise then.
    """

    def __init__(
        self, jump_nm: float, stuck_s: float, clipped_s: float, rate_hz: float, speed: float, noisy: int = 0
    ) -> None:
        self._jump_nm, self._stuck_s, self._clipped_s, self._rate_hz = jump_nm, stuck_s, clipped_s, rate_hz
        self._rails = _Rail(1), _Rail(-1)
        self._first_nm: float | None = None
        self._window_s, self._jitter_s, self._standstill_s = (
            real_s * speed for real_s in (RATE_WINDOW_S, JITTER_S, STANDSTILL_S)
        )
        self._longest_s = 0.0
        self._last: tuple[float, float] | None = None
        self._noisy = noisy
        self._same_since_s: float | None = None
        self._count = 0
        self._anew = False
        self._from_s: float | None = None
        self._prompt: list[tuple[float, int]] = []

    def wrong(self, samples: NDArray[Any]) -> str | None:
        """What is wrong with this block, None if nothing is."""
        torque_nm, now_s = samples["torque_nm"], float(samples["host_time_s"][-1])
        found = self._jumped(torque_nm, now_s) or self._stuck(torque_nm, now_s) or self._off_rate(samples, now_s)
        self._last = float(torque_nm[-1]), now_s
        return found

    def begin(self) -> None:
        """Let what came before say nothing of the rate: an old backlog may have been read. From any thread."""
        self._anew = True

    def _jumped(self, torque_nm: NDArray[np.float64], now_s: float) -> str | None:
        before_nm, before_s = self._last or (float(torque_nm[0]), now_s)
        steps_nm = np.abs(np.diff(torque_nm, prepend=before_nm))
        steps_nm[0] -= FASTEST_NM_S * max(0.0, now_s - before_s - 0.02)  # after a gap it may have gone far
        worst_nm = float(np.max(steps_nm))
        if worst_nm <= self._jump_nm or np.isnan(worst_nm):  # no number is told elsewhere
            return None
        return (
            f"load cell: torque_jump_nm {worst_nm:.2f} N·m from one sample to the next is outside "
            f"0 … {self._jump_nm:g}: a knock, a loose cable, or a turned sign"
        )

    def _stuck(self, torque_nm: NDArray[np.float64], now_s: float) -> str | None:
        before_nm = self._last[0] if self._last else float(torque_nm[0])
        self._first_nm = before_nm if self._first_nm is None else self._first_nm
        at_rail = [rail.holds(torque_nm, before_nm) for rail in self._rails]
        at_end = any(at_rail) and abs(torque_nm[-1] - self._first_nm) >= RAIL_LEAST_NM
        if not (np.all(torque_nm == torque_nm[0]) and torque_nm[0] == before_nm):
            self._noisy += 1
            self._same_since_s = None
            return None
        if self._same_since_s is None:
            self._same_since_s = now_s
        stood_s = now_s - self._same_since_s
        allowed_s = self._clipped_s if at_end else self._stuck_s
        if self._noisy < 3 or stood_s < allowed_s:  # one without noise may well stand still
            return None
        told = f"load cell: its value has stood at exactly {torque_nm[0]:.3f} N·m"
        if at_end:
            return f"{told}, its end, for too long: more would not be seen; widen its range or stimulate less"
        return f"{told}; it is stuck, check its amplifier"

    def _off_rate(self, samples: NDArray[Any], now_s: float) -> str | None:
        if self._anew:
            self._anew, self._from_s, self._prompt = False, None, []
        self._count += len(samples)
        number = int(samples["counter"][-1])
        number = number if number >= 0 else self._count
        self._keep_promptest(now_s, number)
        from_s, third_s = self._counted_from(len(samples), now_s), self._window_s / 3
        if now_s - from_s < self._window_s:
            return None
        begin_s = now_s - self._window_s
        rate_hz = self._rate((begin_s, begin_s + third_s), (now_s - third_s, now_s))
        if rate_hz is None or abs(rate_hz / self._rate_hz - 1) <= RATE_TOLERANCE:
            return None
        return self._told(rate_hz)

    def _counted_from(self, count: int, now_s: float) -> float:
        """Time from which the rate is counted: after a standstill, when what piled up has been read."""
        gap_s = 0.0 if self._last is None else now_s - self._last[1]
        behind_s = gap_s - count / self._rate_hz
        self._longest_s = max(self._longest_s, behind_s)
        if self._from_s is None:
            self._from_s = now_s
        elif behind_s > self._standstill_s:
            self._from_s = max(self._from_s + gap_s, now_s) + behind_s
        return self._from_s

    def _rate(self, early: tuple[float, float], late: tuple[float, float]) -> float | None:
        """Samples a second between the promptest blocks of two spans of time, s; None where one has no block."""
        first, last = self._promptest(*early), self._promptest(*late)
        if first is None or last is None or last[0] <= first[0]:
            return None
        return (last[1] - first[1]) / (last[0] - first[0])

    def _delay_s(self, block: tuple[float, int]) -> float:
        """By how much a block came late, up to a constant, if the rate is the nominal one."""
        return block[0] - block[1] / self._rate_hz

    def _promptest(self, from_s: float, to_s: float) -> tuple[float, int] | None:
        """The block that came with the least delay: one that piled up, or that a busy host read late, is not it."""
        low, high = bisect_left(self._prompt, (from_s, 0)), bisect_right(self._prompt, (to_s, sys.maxsize))
        return min(self._prompt[low:high], key=self._delay_s, default=None)

    def _keep_promptest(self, now_s: float, number: int) -> None:
        kept = self._prompt
        if not kept or int(kept[-1][0] / BIN_S) != int(now_s / BIN_S):
            kept.append((now_s, number))
        elif self._delay_s((now_s, number)) < self._delay_s(kept[-1]):
            kept[-1] = now_s, number

    def wrong_at_end(self) -> str | None:
        """Was the rate over the whole test another than the rig file's? None: no, or too little came to tell.

        `wrong` says nothing in a test shorter than its window, or where longer standstills follow one another.
        The longest standstill may bend this rate by that much, which is allowed for.
        """
        if len(self._prompt) < 3:
            return None
        begin_s, end_s = self._prompt[0][0], self._prompt[-1][0]
        third_s = (end_s - begin_s) / 3
        rate_hz = self._rate((begin_s, begin_s + third_s), (end_s - third_s, end_s))
        tolerance = RATE_TOLERANCE + max(self._jitter_s, self._longest_s) / (end_s - begin_s)
        if rate_hz is None or abs(rate_hz / self._rate_hz - 1) <= tolerance:
            return None
        return self._told(rate_hz)

    def _told(self, rate_hz: float) -> str:
        return (
            f"load cell: {rate_hz:.0f} samples/s come, the rig file says {self._rate_hz:g}; check its settings and bus"
        )


class _Rail:
    """The most that a cell has given (the least, with sign -1), and how often it came to that very number."""

    def __init__(self, sign: int) -> None:
        self._sign, self._end_nm, self._visits = sign, -np.inf, 0

    def holds(self, torque_nm: NDArray[np.float64], before_nm: float) -> bool:
        """Does the last of these samples stand at what may be the amplifier's end?"""
        signed_nm = self._sign * np.concatenate(([before_nm], torque_nm))
        most_nm = float(np.max(signed_nm))
        if most_nm > self._end_nm:
            self._end_nm, self._visits = most_nm, 0
        there = signed_nm == self._end_nm
        self._visits += int(np.sum(there[1:] & ~there[:-1]))
        return bool(there[-1]) and self._visits >= RAIL_VISITS
