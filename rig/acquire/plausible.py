"""Torque that no arm and no sound cell can give: a jump, a value that stands still, a rate that is another.

A sign that was turned while the torque was near zero, or an amplifier that clips for a moment, cannot be told from a
muscle here; the identification sees those.
"""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.align import robust_rate

RATE_WINDOW_S = 3.0
"""Real seconds over which the rate is taken, between the promptest blocks of its first and last third."""
RATE_TOLERANCE = 0.035
HOLE_S = 0.06
"""A host or line that stood still for longer leaves a backlog; it is read in less time than it took to pile up."""
BIN_S = 0.1
"""Rig seconds of which the promptest block is kept for the rate."""
FASTEST_NM_S = 1000.0


class Plausible:
    """Judges the samples of one test, block by block.

    Parameters
    ----------
    jump_nm
        Largest change from one sample to the next.
    stuck_s
        How long, in rig seconds, exactly the same value may stand in a cell that had noise before.
    rate_hz
        Nominal.
    speed
        Rig seconds a real second.
    noisy
        How often the value changed shortly before the test: a cell that is stuck from its start on had noise then.
    """

    def __init__(self, jump_nm: float, stuck_s: float, rate_hz: float, speed: float, noisy: int = 0) -> None:
        self._jump_nm, self._stuck_s, self._rate_hz = jump_nm, stuck_s, rate_hz
        self._window_s, self._hole_s = RATE_WINDOW_S * speed, HOLE_S * speed
        self._piled_until_s = -np.inf
        self._last: tuple[float, float] | None = None
        self._noisy = noisy
        self._same_since_s: float | None = None
        self._count = 0
        self._first_s: float | None = None
        self._prompt: list[tuple[float, int]] = []

    def wrong(self, samples: NDArray[Any]) -> str | None:
        """What is wrong with this block, None if nothing is."""
        torque_nm, now_s = samples["torque_nm"], float(samples["host_time_s"][-1])
        found = self._jumped(torque_nm, now_s) or self._stuck(torque_nm, now_s) or self._off_rate(samples, now_s)
        self._last = float(torque_nm[-1]), now_s
        return found

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
        before_nm = self._last[0] if self._last else torque_nm[0]
        if not (np.all(torque_nm == torque_nm[0]) and torque_nm[0] == before_nm):
            self._noisy += 1
            self._same_since_s = None
            return None
        if self._same_since_s is None:
            self._same_since_s = now_s
        stood_s = now_s - self._same_since_s
        if self._noisy < 3 or stood_s < self._stuck_s:  # one without noise may well stand still
            return None
        return f"load cell: its value has stood at exactly {torque_nm[0]:.3f} N·m; it is stuck, check its amplifier"

    def _off_rate(self, samples: NDArray[Any], now_s: float) -> str | None:
        self._count += len(samples)
        number = int(samples["counter"][-1])
        number = number if number >= 0 else self._count
        gap_s = now_s - self._last[1] if self._last is not None else 0.0
        if gap_s > self._hole_s:
            self._piled_until_s = max(self._piled_until_s, now_s + gap_s)
        if now_s < self._piled_until_s:
            return None
        if self._first_s is None:
            self._first_s = now_s
        self._keep_promptest(now_s, number)
        from_s, third_s = now_s - self._window_s, self._window_s / 3
        first, last = self._promptest(from_s, from_s + third_s), self._promptest(now_s - third_s, now_s)
        if now_s - self._first_s < self._window_s or first is None or last is None:
            return None
        rate_hz = (last[1] - first[1]) / (last[0] - first[0])
        if abs(rate_hz / self._rate_hz - 1) <= RATE_TOLERANCE:
            return None
        return self._told(rate_hz)

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

        The window of `wrong` sees nothing in a test that is shorter, or where the host stood still again and again.
        A host that stood still may bend this line by that much, which is allowed for.
        """
        kept = np.array(tuple(self._prompt), dtype=float).reshape(-1, 2)
        if len(kept) < 3:
            return None
        rate_hz = robust_rate(kept[:, 1] / self._rate_hz, kept[:, 0]) * self._rate_hz
        tolerance = RATE_TOLERANCE + self._hole_s / float(np.ptp(kept[:, 0]))
        if abs(rate_hz / self._rate_hz - 1) <= tolerance:
            return None
        return self._told(rate_hz)

    def _told(self, rate_hz: float) -> str:
        return (
            f"load cell: {rate_hz:.0f} samples/s come, the rig file says {self._rate_hz:g}; check its settings and bus"
        )
