"""Jobs that a person asked for, by the ids under which REST lists them."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Awaitable, Callable
from typing import Any

from stimrig.api.errors import ApiError, require_found
from stimrig.api.jobs.job import Job
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.tasks import Tasks

log = logging.getLogger("stimrig.jobs")
MOST_FINISHED = 200
"""Finished jobs that are remembered."""


class Jobs:
    """Starts long work beside the request that asked for it."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.all: dict[str, Job] = {}
        self._numbers = itertools.count(1)
        self._tasks = Tasks(log)
        self.close = self._tasks.close

    def start(self, kind: str, subject: str, work: Callable[[Job], Awaitable[str]], request: Any = None) -> Job:
        """Start work that returns the address of its result, or return the job that runs already on the same request.

        `subject`: the model's id, or the participant's code. `request`: what is asked for, and by whom, where that
        makes it another job. The work calls `job.follow` with what it submits.
        """
        for job in self.all.values():
            if (job.kind, job.subject, job.request, job.state) == (kind, subject, request, "running"):
                return job
        job = Job(kind, id=f"J{next(self._numbers)}", subject=subject, request=request)
        job.start()
        self.all[job.id] = job
        for old in [known.id for known in self.all.values() if known.state != "running"][:-MOST_FINISHED]:
            del self.all[old]
        self._tasks.begin(self._run(job, work))
        return job

    async def _run(self, job: Job, work: Callable[[Job], Awaitable[str]]) -> None:
        try:
            job.complete(await work(job))
        except ApiError as error:
            job.fail(error)
        except Exception as error:
            log.exception("%s %s failed", job.kind, job.id)
            detail = f"{type(error).__name__}. Nothing was lost. See logs/api.log."
            job.fail(ApiError(500, "internal", "Something unexpected went wrong", detail))

    def get(self, job_id: str) -> Job:
        """Return a job. Raises ApiError (404)."""
        fix = "A restart of the service forgets jobs; ask for the result again."
        return require_found(self.all.get(job_id), "job", job_id, fix)

    def cancel(self, job: Job) -> None:
        """Cancel the job in a worker process that it awaits; what is done already stays done."""
        if job.state == "running" and job.part is not None:
            self.pool.cancel(job)
