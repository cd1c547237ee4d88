"""The rig's tasks: coroutines that wait for a time or a signal. No input or output, no threads, no real time.

Everything that the rig decides happens in such tasks, one step after the other. So a step is never interrupted, and
needs no lock. Who owns the tasks calls `run` after each thing that came (bytes, a command, a finished piece of work)
and at the time that `run` returned: `rig.adapters.machine` in the real rig, a simulator on a virtual clock in tests.

What takes long (a disk, building a plan) is handed to the owner with `work`, which runs it elsewhere.
"""

from __future__ import annotations

import heapq
import logging
import math
import types
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from itertools import count
from typing import Any, Generic, TypeVar

from stimrig.rig.clock import Clock

log = logging.getLogger("rig.tasks")

T = TypeVar("T")
Outcome = Callable[[Any, BaseException | None], None]
Worker = Callable[[Callable[[], Any], Outcome], None]
"""Runs an action elsewhere and hands its result, or what it raised, to the outcome, in the tasks' own thread."""


POLL_S = 0.005
LONGEST_LOOK_S = 0.05
"""Real seconds that count at most between two looks: a computer that stood still has not waited for a device."""


class Signal:
    """Wakes who waits for it, once it is set."""

    def __init__(self) -> None:
        self._set = False
        self._waiting: dict[Task[Any], int] = {}
        self.awaited = False
        """True once a task has waited for it."""

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        """Set it and wake all who wait."""
        self._set = True
        waiting, self._waiting = self._waiting, {}
        for task, turn in waiting.items():
            task.wake(turn)

    def clear(self) -> None:
        """Take it back: who waits from now on waits for the next time."""
        self._set = False

    def add(self, task: Task[Any], turn: int) -> None:
        """Wake this task, if it still waits in this turn."""
        self._waiting[task], self.awaited = turn, True


class Task(Generic[T]):
    """One running coroutine. `done` is set when it has ended."""

    def __init__(self, tasks: Tasks, coroutine: Coroutine[Any, Any, T], name: str) -> None:
        self.name = name
        self.done = Signal()
        self.error: BaseException | None = None
        self.turn = 0
        """Counts how often it waited: a wake that was meant for an earlier wait does nothing."""
        self._tasks, self._coroutine = tasks, coroutine
        self._result: T | None = None

    def wake(self, turn: int, first: bool = False) -> None:
        """Go on in the next `run`; `first`: before the others."""
        if turn == self.turn and not self.done.is_set():
            self.turn += 1
            self._tasks.make_ready(self, first)

    def step(self) -> None:
        """Run until it waits or ends."""
        try:
            self._coroutine.send(None)
        except StopIteration as ended:
            self._result = ended.value
            self.done.set()
        except Exception as error:
            self.error = error
            self.done.set()

    @property
    def result(self) -> T:
        assert self.done.is_set(), f"{self.name} has not ended"
        if self.error is not None:
            raise self.error
        return self._result  # type: ignore


@types.coroutine
def _suspend() -> Generator[None]:
    yield


class Tasks:
    """All tasks of one rig."""

    def __init__(self, clock: Clock, worker: Worker) -> None:
        self.clock = clock
        self._worker = worker
        self._ready: deque[Task[Any]] = deque()
        self._timers: list[tuple[float, int, Task[Any], int]] = []
        self._order = count()
        self._current: Task[Any] | None = None

    def spawn(self, coroutine: Coroutine[Any, Any, T], name: str) -> Task[T]:
        """Start a task; it takes its first step in the next `run`."""
        task = Task(self, coroutine, name)
        self._ready.append(task)
        return task

    def begin(self, coroutine: Coroutine[Any, Any, T], name: str) -> Task[T]:
        """Start a task that takes its first step at once, before those whose time has come; not within a task.

        So a stop that came while nothing ran counts before the pulse that is due by then.
        """
        task = Task(self, coroutine, name)
        self._step(task)
        return task

    def make_ready(self, task: Task[Any], first: bool) -> None:
        """Let a task go on in the next `run`."""
        self._ready.appendleft(task) if first else self._ready.append(task)

    def run(self) -> float:
        """Let every task go on that can; gives the time at which the next one wants to, rig seconds (inf: none)."""
        while True:
            self._wake_due(self.clock.now_s())
            if not self._ready:
                return self._next_s()
            task = self._ready.popleft()
            self._step(task)
            if task.error is not None and not task.done.awaited:
                log.error("task %s failed", task.name, exc_info=task.error)

    async def wait(self, until_s: float, *signals: Signal) -> bool:
        """Wait until a time, or until one of the signals is set: then True, at once if it is set already."""
        if any(signal.is_set() for signal in signals):
            return True
        task = self._current
        assert task is not None, "only a task can wait"
        for signal in signals:
            signal.add(task, task.turn)
        if until_s < math.inf:
            heapq.heappush(self._timers, (until_s, next(self._order), task, task.turn))
        await _suspend()
        return any(signal.is_set() for signal in signals)

    async def sleep(self, real_s: float, *signals: Signal) -> bool:
        """Wait for so many real seconds, or until one of the signals is set."""
        return await self.wait(self.clock.now_s() + real_s * self.clock.speed, *signals)

    async def look_again(self, *signals: Signal) -> float:
        """Let what comes come for a moment; return how many real seconds of it count as waiting."""
        looked_s = self.clock.now_s()
        await self.sleep(POLL_S, *signals)
        return min((self.clock.now_s() - looked_s) / self.clock.speed, LONGEST_LOOK_S)

    async def join(self, task: Task[T]) -> T:
        """Wait until a task has ended; gives what it returned, raises what it raised."""
        await self.wait(math.inf, task.done)
        return task.result

    async def work(self, action: Callable[..., T], *arguments: Any) -> T:
        """Have something done that takes long; gives what it returns, raises what it raises."""
        done, outcomes = Signal(), list[tuple[Any, BaseException | None]]()

        def outcome(result: Any, error: BaseException | None) -> None:
            outcomes.append((result, error))
            done.set()

        self._worker(lambda: action(*arguments), outcome)
        await self.wait(math.inf, done)
        result, error = outcomes[0]
        if error is not None:
            raise error
        return result

    def _step(self, task: Task[Any]) -> None:
        self._current = task
        task.step()
        self._current = None

    def _wake_due(self, now_s: float) -> None:
        due = []
        while self._timers and self._timers[0][0] <= now_s:
            due.append(heapq.heappop(self._timers))
        for _, _, task, turn in reversed(due):  # each goes to the front: the earliest ends up first
            task.wake(turn, first=True)

    def _next_s(self) -> float:
        while self._timers and self._timers[0][2].turn != self._timers[0][3]:
            heapq.heappop(self._timers)  # it was woken by a signal meanwhile
        return self._timers[0][0] if self._timers else math.inf


class Turn:
    """One at a time: `async with turn:`. Who comes later waits, in order."""

    def __init__(self, tasks: Tasks) -> None:
        self._tasks, self._locked = tasks, False
        self._queue: deque[Signal] = deque()

    async def __aenter__(self) -> None:
        if self._locked:
            mine = Signal()
            self._queue.append(mine)
            await self._tasks.wait(math.inf, mine)
        self._locked = True

    async def __aexit__(self, *_: object) -> None:
        if self._queue:
            self._queue.popleft().set()  # it stays held, for the next one
        else:
            self._locked = False
