"""identify at work in processes of its own: never in the web process, cancellable, kept warm."""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from api.errors import ApiError
from api.logs import current_test
from api.workers.process import WORKER, Job, Places, Worker

log = logging.getLogger("stimrig.fitting")


class Fitting:
    """A few workers and a queue; the fit after a test goes before everything else.

    One worker more, of low priority, does what nobody waits for yet; a new test ends what it does.

    Parameters
    ----------
    workers : int
        How many processes.
    command : tuple of str
        How to start one; tests put another in its place.
    places : Places
        The folders that they may reach.
    """

    def __init__(self, workers: int = 2, command: tuple[str, ...] = WORKER, places: Places | None = None) -> None:
        places = places or Places()
        self.workers = [Worker(command, places) for _ in range(workers)]
        self.workers.append(Worker(command, places, background=True))
        self.queue: deque[Job] = deque()
        self.done_count = 0
        self.failed_count = 0
        self.busy_s = 0.0
        self._numbers = itertools.count(1)
        self._tasks: set[asyncio.Task[None]] = set()

    def submit(
        self,
        verb: str,
        *,
        urgent: bool = False,
        background: bool = False,
        on_progress: Callable[[Job], None] | None = None,
        **arguments: Any,
    ) -> Job:
        """Queue a job; await ``job.result``."""
        job = Job(next(self._numbers), verb, arguments, urgent, background, on_progress=on_progress)
        job.result.add_done_callback(_retrieve)
        if urgent:
            self.queue.appendleft(job)
        else:
            self.queue.append(job)
        self._dispatch()
        return job

    def warm(self) -> None:
        """Have every worker load identify before it is needed."""
        for worker in self.workers:
            if not worker.background:
                self.submit("warm")

    def cancel_background(self) -> int:
        """End what nobody waits for, so that a test has the machine to itself; how many jobs that were."""
        open_jobs = [job for job in self.queue if job.background]
        open_jobs += [worker.job for worker in self.workers if worker.job is not None and worker.job.background]
        for job in open_jobs:
            self.cancel(job)
        return len(open_jobs)

    def cancel(self, job: Job) -> None:
        """Take a job off the queue, or end the process that does it."""
        if job.state == "queued":
            self.queue.remove(job)
        for worker in self.workers:
            if worker.job is job:
                job.state = "cancelled"
                worker.kill()
                return
        if not job.result.done():
            job.state = "cancelled"
            job.result.set_exception(ApiError(409, "cancelled", "The job was cancelled", "Start it again if wanted."))

    def _dispatch(self) -> None:
        for worker in self.workers:
            job = self._next_for(worker) if worker.job is None else None
            if job is not None:
                self.queue.remove(job)
                worker.job = job
                task = asyncio.create_task(self._work(worker, job))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    def _next_for(self, worker: Worker) -> Job | None:
        """The next job for a worker; the first of several is kept free for the fit after a test."""
        reserved = worker is self.workers[0] and len(self.workers) > 2
        for job in self.queue:
            fits = job.background == worker.background
            if fits and (not reserved or job.urgent or job.verb == "warm"):
                return job
        return None

    async def _work(self, worker: Worker, job: Job) -> None:
        job.state, job.started_s = "running", time.monotonic()
        current_test.set(job.test_id)  # a task of its own; whoever happened to dispatch it may have had another test
        try:
            result = await worker.run(job)
            job.state, job.progress = "done", 1.0
            self.done_count += 1
            log.info("%s done in %.1f s", job.verb, job.elapsed_s)
            if not job.result.done():
                job.result.set_result(result)
        except (ApiError, OSError, ValueError) as error:
            if job.state != "cancelled":
                job.state = "failed"
            self.failed_count += 1
            log.warning("%s: %s", job.verb, error)
            if not job.result.done():
                job.result.set_exception(error)
        finally:
            self.busy_s += time.monotonic() - job.started_s
            worker.job = None
            self._dispatch()

    async def close(self) -> None:
        """End all workers; what is queued is left."""
        self.queue.clear()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(worker.close() for worker in self.workers))


def _retrieve(future: asyncio.Future[dict[str, Any]]) -> None:
    """A failed job nobody waits for is in the log already."""
    if not future.cancelled():
        future.exception()
