"""The process that lets paced time go on, or wait (`paced_clock.py` says what for).

Every `TICK_S` it looks whether somebody is left without a processor, and lets time wait while it is so:

- a processor itself: a thread of this process on each of them, before all others, has not run for `LATE_S`. Its host
  gave it to somebody else.
- a process that keeps time: it has not said for `LATE_S` that it runs, though one of its threads is ready to run, and
  it has used less than `OWN_SHARE` of a processor meanwhile. Nor has another process that keeps time, and runs before
  ordinary ones, as a rig does, used that much of all processors: it keeps the others away then.

So time does not wait for a process that computes, or that waits for a disk, for a lock, or for a call that holds
Python's own lock. It does not wait for a process that has ended, nor for one that was stopped, unless `make pauses`
did it (`tests/harness/pauses.py`): that stands for a machine that pauses. It waits for `LOST_NS` at most.

Nobody can read more than `AHEAD_S` beyond what was written last: when this process itself gets no processor, time waits
as well. So at most about `LATE_S + TICK_S + AHEAD_S` of a standstill are seen, 0.043 s. That is enough to drop a pulse,
so no test judges how many are dropped. The shortest other time on which a test on the wire depends is of 0.1 s.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from pathlib import Path

if __package__:
    from tests.harness.paced_time.paced_clock import (
        BEAT_S,
        FOR_EVER_NS,
        LOST_NS,
        PLACES,
        PacedClock,
        real_ns,
        real_sleep,
    )
else:
    from paced_clock import BEAT_S, FOR_EVER_NS, LOST_NS, PLACES, PacedClock, real_ns, real_sleep

TICK_S = 0.003
LATE_S = 0.030
AHEAD_S = 0.010
OWN_SHARE = 0.3
PAUSED = "STIMRIG_TESTS_PAUSED"
"""The environment variable with the folder of the disturber, where there is one."""
PRIORITY = 60
"""Above that of the sender of a rig's pulses: a sender that computes takes no processor from this process."""


class Conductor:
    """Writes the file.

    Parameters
    ----------
    path
        The file, `BYTES` long.
    processors
        When each processor was last seen to run, ns of real time, by its number.
    """

    def __init__(self, path: str, processors: dict[int, int]) -> None:
        self._clock, self._processors = PacedClock(), processors
        self._clock.follow(path)
        self._heard: dict[int, tuple[int, dict[int, int]]] = {}

    def begin(self, now_ns: int) -> None:
        """Paced time begins as real time."""
        self._clock.write(now_ns, now_ns, int(AHEAD_S * 1e9))

    def tick(self, now_ns: int) -> None:
        """Look after everybody, and go on or wait."""
        paced_ns, left_ns = self._clock.read(now_ns)
        # while it waits, what a reader may have read already stays the limit: time never goes back
        self._clock.write(paced_ns, now_ns, left_ns if self._someone_waits(now_ns) else int(AHEAD_S * 1e9))

    def end(self, now_ns: int) -> None:
        """Let real time go on for whoever still reads."""
        self._clock.write(self._clock.read(now_ns)[0], now_ns, FOR_EVER_NS)

    def _someone_waits(self, now_ns: int) -> bool:
        late = any(LATE_S * 1e9 < now_ns - seen_ns <= LOST_NS for seen_ns in self._processors.values())
        used_ns = {place: processor_ns(pid) for place in PLACES if (pid := self._clock.cells[place])}
        for place in used_ns:
            late = self._waits(place, used_ns, now_ns) or late
        return late

    def _waits(self, place: int, used_ns: dict[int, int], now_ns: int) -> bool:
        """One process: whether it is left without a processor; what every process has used until now."""
        pid, heard_ns = self._clock.cells[place], self._clock.cells[place + 1]
        if self._heard.get(place, (0, {}))[0] != heard_ns:
            self._heard[place] = heard_ns, used_ns
        silent_ns = now_ns - heard_ns
        if not (LATE_S * 1e9 < silent_ns <= LOST_NS):
            return False
        states = states_of(pid)
        if states <= {"X", "Z"}:
            self._clock.cells[place] = 0
        if paused(pid):
            return True
        before_ns = self._heard[place][1]
        meanwhile_ns = {other: used - before_ns.get(other, used) for other, used in used_ns.items()}
        return "R" in states and not (
            meanwhile_ns.pop(place) >= OWN_SHARE * silent_ns or self._kept_away(meanwhile_ns, silent_ns)
        )

    def _kept_away(self, used_ns: dict[int, int], silent_ns: int) -> bool:
        """Whether one of these processes takes the processors from ordinary ones."""
        most_ns = OWN_SHARE * silent_ns * len(self._processors)
        return any(used >= most_ns and runs_first(self._clock.cells[place]) for place, used in used_ns.items())


def processor_ns(pid: int) -> int:
    """Processor time that a process has used, ns; 0 if it has ended."""
    try:
        return time.clock_gettime_ns((~pid << 3) | 2)  # the kernel's number of that process's clock
    except OSError:
        return 0


def states_of(pid: int) -> set[str]:
    """One letter for each thread, as /proc tells it: R ready to run, T stopped, Z ended; none: there is no process."""
    found = set()
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                found.add((thread / "stat").read_text().rpartition(") ")[2][:1])
    return found


def paused(pid: int) -> bool:
    """Whether the disturber has stopped it: its folder holds a file of that name."""
    folder = os.environ.get(PAUSED)
    return folder is not None and Path(folder, str(pid)).exists()


def runs_first(pid: int) -> bool:
    """Whether a process runs before ordinary ones."""
    try:
        return os.sched_getscheduler(pid) != os.SCHED_OTHER
    except OSError:
        return False


def be_first() -> None:
    """Run before all others where it is allowed; for the thread that calls it."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))


def stand_on(number: int, processors: dict[int, int]) -> None:
    """Say again and again that this processor runs: the body of a thread."""
    os.sched_setaffinity(0, {number})
    be_first()
    while True:
        processors[number] = real_ns()
        real_sleep(BEAT_S)


def main(path: str, ready: int) -> None:
    """Run until the parent has ended."""
    parent, processors = os.getppid(), dict.fromkeys(os.sched_getaffinity(0), real_ns())
    conductor = Conductor(path, processors)
    conductor.begin(real_ns())
    for number in processors:
        threading.Thread(target=stand_on, args=(number, processors), daemon=True).start()
    be_first()
    os.write(ready, b"1")
    while os.getppid() == parent:
        conductor.tick(real_ns())
        real_sleep(TICK_S)
    conductor.end(real_ns())


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
