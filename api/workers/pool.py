"""identify at work in processes of its own: never in the web process, cancellable, kept warm; some beside the queue."""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.logs import current_test
from stimrig.api.workers.process import WORKER, Call, Places, Worker, cancelled

log = logging.getLogger("stimrig.fitting")


class Tasks:
    """Work in the background; an error in it is logged."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._running: set[asyncio.Task[None]] = set()

    def begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Do it beside what waits."""
        task = asyncio.create_task(work)
        self._running.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._log.error("what went on in the background has failed", exc_info=error)

    async def close(self) -> None:
        """End all of it."""
        running = list(self._running)
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


class Pool:
    """A few workers and a queue; the fit after a test goes before everything else.

    One worker more, of low priority, does what nobody waits for yet; a new test ends what it does.

    `workers`: how many processes. `command`: how to start one; tests put another in its place. `places`: the folders
    that they may reach.
    """

    def __init__(self, workers: int = 2, command: tuple[str, ...] = WORKER, places: Places | None = None) -> None:
        self.places = places or Places()
        self.workers = [Worker(command, self.places) for _ in range(workers)]
        self.workers.append(Worker(command, self.places, background=True))
        self.queue: deque[Call] = deque()
        self.done_count = 0
        self.failed_count = 0
        self.busy_s = 0.0
        self._numbers = itertools.count(1)
        self._tasks = Tasks(log)

    def submit(
        self,
        verb: str,
        *,
        urgent: bool = False,
        background: bool = False,
        on_progress: Callable[[Call], None] | None = None,
        **arguments: Any,
    ) -> Call:
        """Queue a call; await ``call.result``."""
        call = Call(next(self._numbers), verb, arguments, urgent, background, on_progress=on_progress)
        call.result.add_done_callback(  # a failed call that nobody waits for is in the log already
            lambda done: done.cancelled() or done.exception()
        )
        if urgent:
            self.queue.appendleft(call)
        else:
            self.queue.append(call)
        self._dispatch()
        return call

    def warm(self) -> None:
        """Have every worker load identify before it is needed."""
        for worker in self.workers:
            if not worker.background:
                self.submit("warm")

    def cancel_background(self) -> int:
        """End what nobody waits for, so that a test has the machine to itself; how many calls that were."""
        open_calls = [call for call in self.queue if call.background]
        open_calls += [worker.call for worker in self.workers if worker.call is not None and worker.call.background]
        for call in open_calls:
            self.cancel(call)
        return len(open_calls)

    def cancel(self, call: Call) -> None:
        """Take a call off the queue, or end the process that does it."""
        if call.state == "queued":
            self.queue.remove(call)
        for worker in self.workers:
            if worker.call is call:
                call.state = "cancelled"
                worker.kill()
                return
        if not call.result.done():
            call.state = "cancelled"
            call.result.set_exception(cancelled())

    def _dispatch(self) -> None:
        for worker in self.workers:
            call = self._next_for(worker) if worker.call is None else None
            if call is not None:
                self.queue.remove(call)
                worker.call = call
                call.state, call.started_s = "running", time.monotonic()
                self._tasks.begin(self._work(worker, call))

    def _next_for(self, worker: Worker) -> Call | None:
        """The next call for a worker; the first of several is kept free for the fit after a test."""
        reserved = worker is self.workers[0] and len(self.workers) > 2
        for call in self.queue:
            fits = call.background == worker.background
            if fits and (not reserved or call.urgent or call.verb == "warm"):
                return call
        return None

    async def _work(self, worker: Worker, call: Call) -> None:
        current_test.set(call.test_id)  # a task of its own; whoever happened to dispatch it may have had another test
        try:
            result = await worker.run(call)
            call.state, call.progress = "done", 1.0
            self.done_count += 1
            log.info("%s done in %.1f s", call.verb, call.elapsed_s)
            if not call.result.done():
                call.result.set_result(result)
        except Exception as error:  # whatever it is: who waits for the call must hear of its end
            if call.state != "cancelled":
                call.state = "failed"
            self.failed_count += 1
            log.warning("%s: %s", call.verb, error)
            if not call.result.done():
                call.result.set_exception(error)
        finally:
            self.busy_s += call.elapsed_s
            worker.call = None
            self._dispatch()

    async def close(self) -> None:
        self.queue.clear()
        await self._tasks.close()
        await asyncio.gather(*(worker.close() for worker in self.workers))


class Adviser:
    """Answers one question at a time, beside the pool: nothing else keeps it busy.

    It is started by the first question, so whoever asks none has no such process. For an adaptive test that is what it
    can reach: during the test it is warm.

    `command`: how to start the worker; tests put another in its place. `places`: the folders that it may reach.
    """

    def __init__(self, command: tuple[str, ...] = WORKER, places: Places | None = None) -> None:
        self.worker = Worker(command, places or Places())
        self._numbers = itertools.count(1)
        self._turn = asyncio.Lock()
        self._knows: asyncio.subprocess.Process | None = None
        """The process that keeps the test."""

    async def ask(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """Its answer.

        Raises ApiError: the worker refused, took too long or died; the next question starts a new one, which knows of
        no test.
        """
        async with self._turn:
            if verb == "adaptive_advise" and await self.worker.start() is not self._knows:
                detail = "It ended between two questions. Your data are safe. See logs/api.log."
                raise ApiError(500, "worker-died", "The worker process died", detail)
            if verb == "adaptive_begin":
                self._knows = None
            found = await self.worker.run(Call(next(self._numbers), verb, arguments))
            if verb == "adaptive_begin":
                self._knows = self.worker.process
            return found

    async def close(self) -> None:
        await self.worker.close()
