"""The machine that this process runs on; see `stimrig.rig.machine.Machine`."""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import queue
import threading
import time
import uuid
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager
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
    """Owns the thread. `post` and `ask` may be called from any thread."""

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

    def ask(self, make: Callable[[], Coroutine[Any, Any, T]]) -> Future[T]:
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


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage collection, and real-time priority for this thread if the system allows it."""
    gc.collect()
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


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class LocalMachine:
    """Threads, ports, adapters and files of this machine."""

    def __init__(self, clock: Clock) -> None:
        self.driver = Driver(clock)
        self.tasks, self.boot_id = self.driver.tasks, boot_id()
        self.disk: Disk = Files()

    def port(self, path: str, **arguments: Any) -> SerialPort:
        return SerialPort(path, self.tasks.clock, self.driver.post, **arguments)

    def open_bus(self, arguments: dict[str, Any], name: str) -> CanBus:
        return CanBus(arguments, name, self.tasks.clock, self.driver.post)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> CanBus | None:
        return CanBus.find(arguments, name)

    def undisturbed(self) -> AbstractContextManager[None]:
        return undisturbed()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    def cpu_s(self) -> float:
        return time.process_time()


def boot_id() -> str:
    try:
        return BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        return ""
