"""Virtual time: a clock that jumps from event to event, and the machine of a rig whose tasks run on it."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Coroutine, Iterator
from itertools import count
from typing import Any, TypeVar

from stimrig.rig.adapters.files import Files
from stimrig.rig.machine import Bus, Disk, Port
from stimrig.rig.tasks import Outcome, Tasks

T = TypeVar("T")


class VirtualClock:
    """A rig's clock that moves only when it is told to."""

    def __init__(self, start_s: float = 1000.0, unix_start_s: float = 1_700_000_000.0) -> None:
        self.speed = 1.0
        self._now_s = start_s
        self._unix_offset_s = unix_start_s - start_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def now_s(self) -> float:
        return self._now_s

    def unix_s(self) -> float:
        return self._now_s + self._unix_offset_s

    def set_unix_ahead(self, duration_s: float) -> None:
        """The wall clock is set ahead (negative: back); the monotonic clock does not notice."""
        self._unix_offset_s += duration_s

    def call_at(self, time_s: float, action: Callable[[], None]) -> None:
        """Run `action` when the clock passes `time_s`."""
        heapq.heappush(self._events, (time_s, next(self._order), action))

    def advance(self, duration_s: float) -> None:
        """Jump without running events: the process was not scheduled."""
        self._now_s += duration_s

    def run(self, tasks: Tasks, until_s: float, ended: Callable[[], bool] = lambda: False) -> bool:
        """Run events and tasks in the order of their time until `until_s`, or until `ended`: then True.

        What came is taken before any task goes on, as the real rig does it.
        """
        while True:
            next_s = tasks.run()
            if ended():
                return True
            next_s = min(next_s, self._events[0][0]) if self._events else next_s
            if next_s > until_s:
                self._now_s = max(self._now_s, until_s)
                return False
            self._now_s = max(self._now_s, next_s)
            while self._events and self._events[0][0] <= self._now_s:
                heapq.heappop(self._events)[2]()

    def wait(self, tasks: Tasks, duration_s: float) -> None:
        """Let so much time pass."""
        self.run(tasks, self._now_s + duration_s)


class QuietMachine:
    """What neither virtual nor simulated machines do: nothing disturbs them, and they use no processor."""

    head_start_s = 0.0

    def hold_until(self, time_s: float) -> None: ...

    def blocked_by(self, stood_s: float) -> str:  # noqa: ARG002
        return ""

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        yield

    def cpu_s(self) -> float:
        return 0.0


class VirtualMachine(QuietMachine):
    """A machine whose work is done at once, on a disk that is given; it has no ports and no adapters of its own."""

    def __init__(self, clock: VirtualClock | None = None, disk: Disk | None = None) -> None:
        self.clock = clock or VirtualClock()
        self.tasks = Tasks(self.clock, self._work)
        self.disk: Disk = disk or Files()
        self.boot_id = "this-boot"
        self._ids = count(1)

    def port(self, path: str, **arguments: Any) -> Port:
        raise NotImplementedError(path, arguments)

    def open_bus(self, arguments: dict[str, Any], name: str) -> Bus:
        raise NotImplementedError(arguments, name)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> Bus | None:  # noqa: ARG002
        return None

    def new_id(self) -> str:
        return f"{next(self._ids):032x}"

    def run(self, coroutine: Coroutine[Any, Any, T], within_s: float = 1e4) -> T:
        """Run a task to its end, and everything else meanwhile; gives what it returns, raises what it raises."""
        task = self.tasks.spawn(coroutine, "test")
        assert self.clock.run(self.tasks, self.clock.now_s() + within_s, task.done.is_set), "it did not end"
        return task.result

    def wait(self, duration_s: float) -> None:
        """Let so much time pass."""
        self.clock.wait(self.tasks, duration_s)

    @staticmethod
    def _work(action: Callable[[], Any], outcome: Outcome) -> None:
        try:
            result = action()
        except Exception as error:
            outcome(None, error)
        else:
            outcome(result, None)
