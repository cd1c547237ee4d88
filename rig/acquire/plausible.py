"""Torque that no arm and no sound cell can give: a jump, a value that stands still, a rate that is another.

A sign that was turned while the torque was near zero, or an amplifier that clips for a moment, cannot be told from a
muscle here; the identification sees those.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.align import robust_rate

RATE_WINDOW_S = 3.0
"""Real seconds over which the rate is taken: a hiccup of the host of 60 ms is then 2 %."""
RATE_TOLERANCE = 0.035
HOLE_S = 0.06
BACKLOG_S = 1.0
"""After a hole, what had piled up comes too fast: for so many real seconds nothing is counted."""
BIN_S = 0.1
"""Rig seconds of which the earliest block is kept for the rate over the whole test."""
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
        self._window_s, self._hole_s, self._backlog_s = RATE_WINDOW_S * speed, HOLE_S * speed, BACKLOG_S * speed
        self._counts_from_s = -np.inf
        self._last: tuple[float, float] | None = None
        self._noisy = noisy
        self._same_since_s: float | None = None
        self._arrived: deque[tuple[float, int]] = deque()
        self._count = 0
        self._earliest: list[tuple[float, int]] = []

    def wrong(self, samples: NDArray[Any]) -> str | None:
        """What is wrong with this block, None if nothing is."""
        torque_nm, now_s = samples["torque_nm"], float(samples["host_time_s"][-1])
        found = self._jumped(torque_nm, now_s) or self._stuck(torque_nm, now_s) or self._off_rate(samples, now_s)
        self._last = float(torque_nm[-1]), now_s
        return found

    def count_from(self, time_s: float) -> None:
        """Let what came before say nothing of the rate; from any thread."""
        self._counts_from_s = time_s

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
        self._keep_earliest(now_s, number)
        if self._last is not None and now_s - self._last[1] > self._hole_s:
            self.count_from(now_s + self._backlog_s)  # the host or the line stood still: begin anew
        from_s = self._counts_from_s  # looked at once: another thread may set it
        if now_s < from_s:
            return None
        self._arrived.append((now_s, number))
        while self._arrived[0][0] < max(now_s - 1.5 * self._window_s, from_s):
            self._arrived.popleft()
        first_s, first = self._arrived[0]
        if now_s - first_s < self._window_s:
            return None
        rate_hz = (self._arrived[-1][1] - first) / (now_s - first_s)
        if abs(rate_hz / self._rate_hz - 1) <= RATE_TOLERANCE:
            return None
        return self._told(rate_hz)

    def _keep_earliest(self, now_s: float, number: int) -> None:
        """Of each bin of time the block that came with the least delay."""
        kept = self._earliest
        if not kept or int(kept[-1][0] / BIN_S) != int(now_s / BIN_S):
            kept.append((now_s, number))
        elif now_s - number / self._rate_hz < kept[-1][0] - kept[-1][1] / self._rate_hz:
            kept[-1] = now_s, number

    def wrong_at_end(self) -> str | None:
        """Was the rate over the whole test another than the rig file's? None: no, or too little came to tell.

        The window of `wrong` sees nothing in a test that is shorter, or where the host stood still again and again.
        A host that stood still may bend this line by that much, which is allowed for.
        """
        kept = np.array(tuple(self._earliest), dtype=float).reshape(-1, 2)
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
