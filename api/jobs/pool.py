"""Workers and a queue of jobs: never in the web process, cancellable, kept warm."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import Job, cancelled
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.jobs.worker import Worker
from stimrig.api.logs import current_test

log = logging.getLogger("stimrig.jobs")
MOST_QUEUED = 50
"""Jobs that wait; more are refused, but urgent ones."""
FOR_PAGES = ("comparison", "curves")
"""Urgent jobs that wait behind the other urgent ones: many pages must not keep a test's fit waiting."""


class Pool:
    """A few workers and a queue; the fit after a test goes before everything else.

    `workers`: processes. Of several the first is kept free for urgent jobs; a pool of one keeps what its process
    remembers. `worker`: makes a `Worker`; tests put another in its place.
    """

    def __init__(self, workers: int, worker: Callable[..., Worker] = Worker) -> None:
        self.workers = [worker() for _ in range(workers)]
        self.reserved = self.workers[0] if workers > 1 else None
        self.queue: list[Job] = []
        self.done_count = self.failed_count = 0
        self.busy_s = 0.0
        self._tasks = Tasks(log)

    def submit(
        self, kind: str, *, urgent: bool = False, on_progress: Callable[[Job], None] | None = None, **arguments: Any
    ) -> Job:
        """Queue a job of one verb; await its `result`. Who is cancelled as he awaits it cancels the job.

        Raises ApiError: 503 too many wait already.
        """
        if len(self.queue) >= MOST_QUEUED and not urgent:
            problem = ApiError(
                503, "busy", "Too much at once", "Too many analyses wait already. Try again in a minute."
            )
            problem.headers["Retry-After"] = "60"
            raise problem
        job = Job(kind, arguments, urgent, on_progress)
        job.result.add_done_callback(lambda result: self.cancel(job) if result.cancelled() else None)
        behind = [other for other in self.queue if other.urgent and other.kind not in FOR_PAGES]
        self.queue.insert(len(self.queue) if not urgent else len(behind) if kind in FOR_PAGES else 0, job)
        self._dispatch()
        return job

    def warm(self) -> None:
        """Have every worker load what it needs before it is needed."""
        for _ in self.workers:
            self.submit("warm")

    def cancel(self, job: Job) -> None:
        """Take a job off the queue, or end the process that does it."""
        job = job.part or job
        if job in self.queue:
            self.queue.remove(job)
            job.fail(cancelled())
        for worker in self.workers:
            if worker.job is job:
                job.state = "cancelled"
                worker.end()

    def _dispatch(self) -> None:
        for worker in self.workers:
            may_do = (job for job in self.queue if worker is not self.reserved or job.urgent or job.kind == "warm")
            if worker.job is None and (job := next(may_do, None)) is not None:
                self.queue.remove(job)
                worker.job = job
                job.start()
                self._tasks.begin(self._work(worker, job))

    async def _work(self, worker: Worker, job: Job) -> None:
        current_test.set(job.test_id)  # a task of its own; whoever happened to dispatch it may have had another test
        try:
            job.complete(await worker.run(job))
            self.done_count += 1
            log.info("%s done in %.1f s", job.kind, job.elapsed_s)
        except Exception as error:  # whatever it is: who awaits the job must hear of its end
            job.fail(error)
            self.failed_count += 1
            log.warning("%s: %s", job.kind, error)
        finally:
            self.busy_s += job.elapsed_s
            worker.job = None
            self._dispatch()

    async def close(self) -> None:
        """End all processes."""
        self.queue.clear()
        for worker in self.workers:
            worker.end()
        await self._tasks.close()
        await asyncio.gather(*(worker.close() for worker in self.workers))
