"""The machine that this process runs on; see `stimrig.rig.machine.Machine`."""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import queue
import resource
import threading
import time
import uuid
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from stimrig.rig.adapters.can_bus import CanBus
from stimrig.rig.adapters.files import Files
from stimrig.rig.adapters.serial_port import SerialPort
from stimrig.rig.clock import Clock
from stimrig.rig.machine import Disk
from stimrig.rig.tasks import Outcome, Task, Tasks

log = logging.getLogger("rig.driver")

T = TypeVar("T")
PRIORITY = 50
WORKERS = 8
LONGEST_WAIT_S = 3600.0


class Driver:
    """Owns the thread. `post` and `submit` may be called from any thread."""

    def __init__(self, clock: Clock) -> None:
        self.tasks = Tasks(clock, self._work)
        self._clock = clock
        self._inbox: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Outcome]] = queue.SimpleQueue()
        for number in range(WORKERS):  # daemons: a disk that hangs keeps no process alive
            threading.Thread(target=self._labour, name=f"work-{number}", daemon=True).start()
        self._thread = threading.Thread(target=self._run, name="rig", daemon=True)
        self._thread.start()

    def post(self, action: Callable[[], None]) -> None:
        """Have something done in the tasks' thread, before any task goes on."""
        self._inbox.put(action)

    def submit(self, make: Callable[[], Coroutine[Any, Any, T]]) -> Future[T]:
        """Start a task; the future has its result."""
        future: Future[T] = Future()
        self.post(lambda: self._follow(self.tasks.begin(make(), "request"), future))
        return future

    def end(self) -> None:
        """End the thread; tasks that still wait are forgotten."""
        self._inbox.put(None)
        self._thread.join()

    def _follow(self, task: Task[T], future: Future[T]) -> None:
        async def hand_over() -> None:
            await self.tasks.wait(math.inf, task.done)
            if task.error is not None:
                future.set_exception(task.error)
            else:
                future.set_result(task.result)

        self.tasks.spawn(hand_over(), "answer")

    def _work(self, action: Callable[[], Any], outcome: Outcome) -> None:
        self._jobs.put((action, outcome))

    def _labour(self) -> None:
        while True:
            action, outcome = self._jobs.get()
            try:
                result = action()
            except BaseException as error:
                self.post(partial(outcome, None, error))
            else:
                self.post(partial(outcome, result, None))

    def _run(self) -> None:
        while True:
            next_s = self.tasks.run()
            wait_s = min((next_s - self._clock.now_s()) / self._clock.speed, LONGEST_WAIT_S)
            with contextlib.suppress(queue.Empty):
                action = self._inbox.get(timeout=wait_s) if wait_s > 0 else self._inbox.get_nowait()
                while action is not None:  # what came before is taken before any task goes on
                    try:
                        action()
                    except Exception:  # a bug in this program; whoever waits for the outcome finds out by the time
                        log.exception("something that came could not be taken")
                    action = self._inbox.get_nowait()
                return


HOLD_S = 0.00025
"""Real seconds: the last part of a wait for a deadline, in which nothing else runs; a sleep ends later than asked."""
MOST_OF_IT = 0.5
"""Share of a standstill that a cause must explain to be reported."""
PAGES = 200
"""Pages read back from the disk: less delay nobody."""


class Strain:
    """Causes that kept this thread from running, as far as Linux counts them."""

    def __init__(self) -> None:
        self._before = self._counted()

    def cause(self, stood_s: float) -> str:
        """Why it stood still since the last call, in words."""
        before, self._before = self._before, self._counted()
        waited_s, stolen_s, pages = (now - then for now, then in zip(self._before, before, strict=True))
        if pages >= PAGES:
            return "the computer read memory back from its disk"
        if stolen_s >= MOST_OF_IT * stood_s:
            return "the host of this virtual computer was busy"
        return "other programs kept the computer's processor" if waited_s >= MOST_OF_IT * stood_s else ""

    @staticmethod
    def _counted() -> tuple[float, float, int]:
        """Seconds for which this thread waited for a processor, and all of them for the host; pages that were read."""
        try:
            waited_s = 1e-9 * int(Path("/proc/thread-self/schedstat").read_text().split()[1])
            with Path("/proc/stat").open() as file:
                stolen_s = int(file.readline().split()[8]) / os.sysconf("SC_CLK_TCK")
        except (OSError, ValueError, IndexError):
            return 0.0, 0.0, 0
        return waited_s, stolen_s, resource.getrusage(resource.RUSAGE_SELF).ru_majflt


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class LocalMachine:
    """Threads, ports, adapters and files of this machine."""

    def __init__(self, clock: Clock) -> None:
        self.driver = Driver(clock)
        self.tasks, self.boot_id = self.driver.tasks, ""
        with contextlib.suppress(OSError, ValueError):
            self.boot_id = BOOT_ID.read_text("ascii").strip()
        self.disk: Disk = Files()
        self.head_start_s = 0.0015
        self._strain = Strain()

    def port(self, path: str, **arguments: Any) -> SerialPort:
        return SerialPort(path, self.tasks.clock, self.driver.post, **arguments)

    def open_bus(self, arguments: dict[str, Any], name: str) -> CanBus:
        return CanBus(arguments, name, self.tasks.clock, self.driver.post)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> CanBus | None:
        return CanBus.find(arguments, name)

    def hold_until(self, time_s: float) -> None:
        clock = self.tasks.clock
        left_s = (time_s - clock.now_s()) / clock.speed
        if left_s > HOLD_S:
            time.sleep(min(left_s, self.head_start_s) - HOLD_S)
        while 0 < time_s - clock.now_s() <= HOLD_S * clock.speed:
            pass

    def blocked_by(self, stood_s: float) -> str:
        return self._strain.cause(stood_s)

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """No garbage collection, and real-time priority for this thread if the system allows it."""
        gc.collect()
        gc.freeze()
        gc.disable()
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, policy, parameters)
            gc.enable()
            gc.unfreeze()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    def cpu_s(self) -> float:
        return time.process_time()
