"""The process that lets paced time go on, or wait (`paced_clock.py` says what for).

Every `TICK_S` it looks when each process that keeps time said last that it was given a processor. Where that is longer
ago than `LATE_S`, time waits, unless that process

- computed itself in that time, or was stopped, or has ended: that is its own doing, which a test may want to see;
- has said nothing for `LOST_S`.

Nobody can read more than `AHEAD_S` beyond what was written last: when this process itself gets no processor, time waits
as well. So at most about `LATE_S + TICK_S + AHEAD_S` of a standstill are seen, 0.043 s. The shortest wait on which a
test on the wire depends is of 0.1 s.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

if __package__:
    from tests.harness.paced_time.paced_clock import FIRST_MEMBER, MEMBERS, SLOTS, PacedClock, real_ns, real_sleep
else:
    from paced_clock import FIRST_MEMBER, MEMBERS, SLOTS, PacedClock, real_ns, real_sleep

TICK_S = 0.003
LATE_S = 0.030
AHEAD_S = 0.010
LOST_S = 10.0
OWN_SHARE = 0.3
"""A process that used so much of a processor since it was heard was not left without one."""
PRIORITY = 30
WAITED = FIRST_MEMBER + 2 * MEMBERS
"""The cell that counts how long time has waited in all, ns."""


class Conductor:
    """Writes the file."""

    def __init__(self, path: str) -> None:
        clock = PacedClock()
        clock.follow(path)
        self._cells = clock.cells
        self._heard: dict[int, tuple[int, int]] = {}

    def begin(self, now_ns: int) -> None:
        """Paced time begins as real time."""
        self._write(now_ns, now_ns, AHEAD_S)

    def tick(self, now_ns: int) -> None:
        """Look after everybody, and go on or wait."""
        cells = self._cells
        place = 1 + 3 * (cells[0] % SLOTS)
        passed_ns = now_ns - cells[place + 1]
        went_on_ns = min(passed_ns, cells[place + 2])
        cells[WAITED] += passed_ns - went_on_ns
        self._write(cells[place] + went_on_ns, now_ns, 0.0 if self._someone_waits(now_ns) else AHEAD_S)

    def _write(self, paced_ns: int, now_ns: int, ahead_s: float) -> None:
        number = self._cells[0] + 1
        place = 1 + 3 * (number % SLOTS)
        self._cells[place], self._cells[place + 1], self._cells[place + 2] = paced_ns, now_ns, int(ahead_s * 1e9)
        self._cells[0] = number

    def _someone_waits(self, now_ns: int) -> bool:
        late = False
        for place in range(FIRST_MEMBER, FIRST_MEMBER + 2 * MEMBERS, 2):
            pid = self._cells[place]
            if pid:
                late = self._waits(pid, self._cells[place + 1], place, now_ns) or late
        return late

    def _waits(self, pid: int, heard_ns: int, place: int, now_ns: int) -> bool:
        """One process: whether it is left without a processor."""
        used_ns = processor_ns(pid)
        if self._heard.get(place, (0, 0))[0] != heard_ns:
            self._heard[place] = heard_ns, used_ns
        silent_ns = now_ns - heard_ns
        if silent_ns <= LATE_S * 1e9 or silent_ns > LOST_S * 1e9:
            return False
        state = state_of(pid)
        if state in "XZ":
            self._cells[place] = 0
        return state not in "TtXZ" and used_ns - self._heard[place][1] < OWN_SHARE * silent_ns


def processor_ns(pid: int) -> int:
    """Processor time that a process has used, ns; 0 if it has ended."""
    try:
        return time.clock_gettime_ns((~pid << 3) | 2)  # the kernel's number of that process's clock
    except OSError:
        return 0


def state_of(pid: int) -> str:
    """One letter, as /proc tells it: T stopped, Z ended, X none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][:1]
    except OSError:
        return "X"


def main(path: str, ready: int) -> None:
    """Run until the parent has ended."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    parent = os.getppid()
    conductor = Conductor(path)
    conductor.begin(real_ns())
    os.write(ready, b"1")
    while os.getppid() == parent:
        conductor.tick(real_ns())
        real_sleep(TICK_S)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
