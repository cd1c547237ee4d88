"""Paced time: real time that waits for whoever got no processor.

Tests on the wire run in several processes in real time. A machine that stands still for 0.3 s, as a shared one does
now and then, is seen by the rig as a computer that was blocked; the rig stops, and is right, but the test has shown
nothing. In paced time it does not happen: time goes on at the pace of the world while each process that keeps time is
given a processor, and waits while one is not (`conductor.py` says when). A process that blocks itself, by computing or
by waiting for something, is not waited for: such faults are seen as ever.

All processes of a test share a file that the conductor writes. A child of a test joins by itself: `sitecustomize.py`
lies beside this file, and Python imports it first. Nothing of stimrig knows of paced time. It rules `time.monotonic`
and `time.sleep`, `threading`'s conditions, events and queues, `select.select`, and so asyncio, pyserial and python-can.
Still real are `time.time`, the time limits of sockets, of locks and of pytest.
"""

from __future__ import annotations

import atexit
import fcntl
import mmap
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

VARIABLE = "STIMRIG_TESTS_PACED_TIME"
"""The environment variable that holds the file's path."""
KEEPERS = ("stimrig.rig", "stimrig.hardware_sim", "tests", "bench")
"""Packages whose programs (`python -m …`) time waits for."""
SLOTS, MEMBERS, BYTES = 64, 64, 4096
FIRST_MEMBER = 1 + 3 * SLOTS
PLACES = range(FIRST_MEMBER, FIRST_MEMBER + 2 * MEMBERS, 2)
"""Where the file holds who keeps time: the number of the process, and when it said last that it runs."""
BEAT_S = 0.005
SHORTEST_S = 0.0005
LOST_NS = 10_000_000_000
"""A conductor that has written nothing for so long has ended: real time goes on."""
FOR_EVER_NS = 2**62

real_s, real_ns, real_sleep, real_gettime = time.monotonic, time.monotonic_ns, time.sleep, time.clock_gettime


class PacedClock:
    """Reads the conductor's file: a slot says what paced time was when, and how far a reader may go on from there.

    It follows real time until it is given a file.
    """

    def __init__(self) -> None:
        self.let_go()

    def let_go(self) -> None:
        """Follow real time from now on."""
        self._path, self.cells = "", memoryview(bytearray(BYTES)).cast("q")
        self.write(0, 0, FOR_EVER_NS)

    def follow(self, path: str) -> None:
        """Read this file from now on."""
        with Path(path).open("r+b") as file:
            self._path, self.cells = path, memoryview(mmap.mmap(file.fileno(), BYTES)).cast("q")

    @property
    def paced(self) -> bool:
        """Whether time waits for a process that is left without a processor."""
        return self._path != ""

    def write(self, paced_ns: int, now_ns: int, ahead_ns: int) -> None:
        """Say what paced time is; readers see the whole slot or the one before."""
        number = self.cells[0] + 1
        place = 1 + 3 * (number % SLOTS)
        self.cells[place], self.cells[place + 1], self.cells[place + 2] = paced_ns, now_ns, ahead_ns
        self.cells[0] = number

    def read(self, now_ns: int) -> tuple[int, int]:
        """Paced time at a real time, and how much further it may go on by itself, ns."""
        place = 1 + 3 * (self.cells[0] % SLOTS)
        passed_ns, ahead_ns = max(now_ns - self.cells[place + 1], 0), self.cells[place + 2]
        went_on_ns = min(passed_ns, ahead_ns)
        return self.cells[place] + went_on_ns + max(passed_ns - max(LOST_NS, ahead_ns), 0), ahead_ns - went_on_ns

    def waited_ns(self, now_ns: int) -> int:
        """For how long time has waited in all until a real time, ns."""
        return now_ns - self.read(now_ns)[0]

    def now_s(self) -> float:
        """Paced time, s: monotonic, and the same in all processes of the file."""
        return self.read(real_ns())[0] * 1e-9

    def sleep(self, duration_s: float) -> None:
        """Sleep for so much paced time."""
        if duration_s <= 0:
            return real_sleep(duration_s)
        end_s = self.now_s() + duration_s
        while (left_s := end_s - self.now_s()) > 0:
            real_sleep(max(left_s, SHORTEST_S))
        return None

    def rule(self) -> None:
        """Be the monotonic clock of this process, and what it waits by."""
        time.monotonic, time.sleep = self.now_s, self.sleep
        time.clock_gettime = lambda clock: self.now_s() if clock == time.CLOCK_BOOTTIME else real_gettime(clock)
        select.select = select_paced
        threading.Condition.wait = wait  # pyright: ignore[reportAttributeAccessIssue]
        threading._time = self.now_s  # pyright: ignore[reportAttributeAccessIssue]
        if "queue" in sys.modules:
            sys.modules["queue"].time = self.now_s  # pyright: ignore[reportAttributeAccessIssue]

    def keep(self) -> None:
        """Let time wait for this process from now on: a thread says again and again that it is given a processor."""
        pid = os.getpid()
        with Path(self._path).open("r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            free = [i for i in PLACES if self.cells[i] == pid] or [i for i in PLACES if self.cells[i] == 0]
            if not free:
                raise RuntimeError(f"paced time waits for {MEMBERS} processes at most")
            self.cells[free[0] + 1] = real_ns()
            self.cells[free[0]] = pid
        threading.Thread(target=self._beat, args=(free[0] + 1,), name="paced-time", daemon=True).start()
        atexit.register(self._leave, free[0], pid)

    def _leave(self, place: int, pid: int) -> None:
        if self.cells[place] == pid == os.getpid():  # not a child that was forked from it
            self.cells[place] = 0

    def _beat(self, place: int) -> None:
        while True:
            self.cells[place] = real_ns()
            real_sleep(BEAT_S)


def wait(condition: threading.Condition, timeout: float | None = None) -> bool:
    """`threading.Condition.wait` in paced time."""
    if timeout is None or timeout <= 0:
        return _wait(condition, timeout)
    end_s, left_s = time.monotonic() + timeout, timeout
    while left_s > 0:
        if _wait(condition, max(left_s, SHORTEST_S)):
            return True
        left_s = end_s - time.monotonic()
    return False


def select_paced(
    readable: list[Any], writable: list[Any], other: list[Any], timeout: float | None = None
) -> tuple[list[Any], list[Any], list[Any]]:
    """`select.select` in paced time."""
    if timeout is None or timeout <= 0:
        return _select(readable, writable, other, timeout)
    end_s, left_s = time.monotonic() + timeout, timeout
    while left_s > 0:
        ready = _select(readable, writable, other, max(left_s, SHORTEST_S))
        if any(ready):
            return ready
        left_s = end_s - time.monotonic()
    return [], [], []


_wait: Callable[..., bool] = threading.Condition.wait
_select: Callable[..., tuple[list[Any], list[Any], list[Any]]] = select.select


def join_as_child() -> None:
    """Join if the environment says so."""
    path, line = os.environ.get(VARIABLE), sys.orig_argv
    if path and Path(path).exists():
        clock = PacedClock()
        clock.follow(path)
        clock.rule()
        program = line[line.index("-m") + 1] if "-m" in line[:-1] else ""
        if f"{program}.".startswith(tuple(f"{keeper}." for keeper in KEEPERS)):
            clock.keep()
