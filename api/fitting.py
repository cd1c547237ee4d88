"""identify at work in processes of its own: never in the web process, cancellable, kept warm."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from api.errors import ApiError
from api.logs import current_test

log = logging.getLogger("stimrig.fitting")

WORKER = (sys.executable, "-m", "api.worker")
BACKGROUND_NICE = "15"
"""How far a worker for what nobody waits for stands back."""
LINE_LIMIT = 64 * 1024 * 1024


@dataclass
class Job:
    """One job: what, how far, and a future for its result."""

    id: int
    verb: str
    arguments: dict[str, Any]
    urgent: bool = False
    background: bool = False
    state: str = "queued"
    progress: float = 0.0
    text: str = ""
    started_s: float | None = None
    result: asyncio.Future[dict[str, Any]] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    on_progress: Callable[[Job], None] | None = None
    test_id: str | None = field(default_factory=current_test.get)

    @property
    def elapsed_s(self) -> float:
        """Time since it began, s; 0 while it is queued."""
        return 0.0 if self.started_s is None else time.monotonic() - self.started_s

    @property
    def time_left_s(self) -> float | None:
        """What its pace so far says, s; None before there is a pace."""
        if self.state != "running" or self.progress < 0.05:
            return None
        return self.elapsed_s * (1.0 - self.progress) / self.progress

    def public(self) -> dict[str, Any]:
        """What a client sees of it."""
        left = self.time_left_s
        return {
            "verb": self.verb,
            "state": self.state,
            "progress": round(self.progress, 3),
            "text": self.text,
            "elapsed_s": round(self.elapsed_s, 1),
            "time_left_s": None if left is None else round(left, 1),
        }


class Worker:
    """One worker process, started when first needed and again after a job was cancelled."""

    def __init__(self, command: tuple[str, ...], *, background: bool = False) -> None:
        self.command, self.background = command, background
        self.process: asyncio.subprocess.Process | None = None
        self.job: Job | None = None

    async def start(self) -> asyncio.subprocess.Process:
        """The running process, fresh if there is none."""
        if self.process is None or self.process.returncode is not None:
            command = ("nice", "-n", BACKGROUND_NICE, *self.command) if self.background else self.command
            self.process = await asyncio.create_subprocess_exec(
                *command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=LINE_LIMIT
            )
        return self.process

    async def run(self, job: Job) -> dict[str, Any]:
        """Do a job to its end; its result, or its error raised."""
        process = await self.start()
        assert process.stdin is not None and process.stdout is not None
        request = {"job": job.id, "verb": job.verb, "arguments": job.arguments}
        process.stdin.write(json.dumps(request).encode() + b"\n")
        while line := await process.stdout.readline():
            message = json.loads(line)
            if message.get("job") != job.id:
                continue
            if "result" in message:
                return message["result"]
            if "error" in message:
                raise job_error(job.verb, message["error"])
            job.progress, job.text = message["progress"], message["text"]
            if job.on_progress is not None:
                job.on_progress(job)
        await process.wait()
        if job.state == "cancelled":
            raise ApiError(409, "cancelled", "The job was cancelled", "Start it again if it is still wanted.")
        raise ApiError(500, "worker-died", "The worker process died", "The data are safe; ask again. See logs/api.log.")

    def kill(self) -> None:
        """End the process at once."""
        if self.process is not None and self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.kill()

    async def close(self) -> None:
        """End the process and wait for it."""
        self.kill()
        if self.process is not None:
            await self.process.wait()


def job_error(verb: str, error: dict[str, Any]) -> ApiError:
    """A worker's error as a problem."""
    if error.get("expected"):
        extra = {key: error[key] for key in ("place", "mend") if error.get(key)}
        return ApiError(422, "data", "The data do not allow it", error["detail"], **extra)
    detail = f"{error['detail']}. The data are safe. See logs/api.log."
    return ApiError(500, "analysis-failed", f"The {verb} failed", detail)


class Fitting:
    """A few workers and a queue; the fit after a test goes before everything else.

    One worker more, of low priority, does what nobody waits for yet; a new test ends what it does.

    Parameters
    ----------
    workers : int
        How many processes.
    command : tuple of str
        How to start one; tests put another in its place.
    """

    def __init__(self, workers: int = 2, command: tuple[str, ...] = WORKER) -> None:
        self.workers = [Worker(command) for _ in range(workers)]
        self.workers.append(Worker(command, background=True))
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
