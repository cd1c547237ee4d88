"""Long work that a person waits for: how far, how long yet, cancel; where its result lies once it is done."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.errors import ApiError, require_found
from stimrig.api.workers.pool import Call, Pool, Tasks

log = logging.getLogger("stimrig.jobs")
FIT_TOGETHER = "fit-recordings"
"""Kind of a job whose subject is a participant and not a model."""
KEPT = 200
"""So many finished jobs are remembered."""


@dataclass
class Job:
    """One piece of long work."""

    id: str
    kind: str  # diagnosis, add-effects, improve or fit-recordings
    subject: str  # the model's id; of fit-recordings the participant's code
    by: str
    state: str = "running"
    call: Call | None = None
    result_url: str | None = None
    problem: ApiError | None = None
    done: asyncio.Event = field(default_factory=asyncio.Event)

    def take(self, call: Call) -> None:
        self.call = call

    def document(self) -> dict[str, Any]:
        """What a client sees of it."""
        call = self.call.document() if self.call else {}
        return {
            "id": self.id,
            "kind": self.kind,
            "model_id": None if self.kind == FIT_TOGETHER else self.subject,
            "participant": self.subject if self.kind == FIT_TOGETHER else None,
            "requested_by": self.by,
            "state": self.state,
            "done": self.state != "running",
            "progress": 1.0 if self.state == "completed" else call.get("progress", 0.0),
            "text": call.get("text", ""),
            "elapsed_s": call.get("elapsed_s", 0.0),
            "time_left_s": call.get("time_left_s") if self.state == "running" else 0.0,
            "result_url": self.result_url,
            "problem": self.problem.body(f"/v1/jobs/{self.id}") if self.problem else None,
        }


class Jobs:
    """Starts long work beside the request that asked for it."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.all: dict[str, Job] = {}
        self._numbers = itertools.count(1)
        self._tasks = Tasks(log)

    def start(self, kind: str, subject: str, by: str, work: Callable[[Job], Awaitable[str]]) -> Job:
        """Begin; `work` gives the address of the result. A second start of what runs already gives the first one."""
        for job in self.all.values():
            if (job.kind, job.subject, job.state) == (kind, subject, "running"):
                return job
        job = Job(f"J{next(self._numbers)}", kind, subject, by)
        self.all[job.id] = job
        for old in [known.id for known in self.all.values() if known.state != "running"][: -KEPT or None]:
            del self.all[old]
        self._tasks.begin(self._follow(job, work))
        return job

    async def _follow(self, job: Job, work: Callable[[Job], Awaitable[str]]) -> None:
        try:
            job.result_url = await work(job)
            job.state = "completed"
        except ApiError as error:
            job.state, job.problem = ("cancelled" if error.code == "cancelled" else "failed"), error
        except Exception as error:
            log.exception("%s %s failed", job.kind, job.id)
            detail = f"{type(error).__name__}. Nothing was lost. See logs/api.log."
            job.state, job.problem = "failed", ApiError(500, "internal", "Something unexpected went wrong", detail)
        finally:
            job.done.set()

    def get(self, job_id: str) -> Job:
        fix = "A restart of the service forgets jobs; ask for the result again."
        return require_found(self.all.get(job_id), "job", job_id, fix)

    def cancel(self, job: Job) -> None:
        """End the work; what is done already stays done."""
        if job.state == "running" and job.call is not None:
            self.pool.cancel(job.call)

    async def close(self) -> None:
        await self._tasks.close()
