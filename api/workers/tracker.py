"""Long work that a person waits for: how far, how long yet, cancel; where its result lies once it is done."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from api.errors import ApiError, NotFoundError
from api.workers.pool import Fitting, Job

log = logging.getLogger("stimrig.tasks")
KEPT = 200
"""So many finished tasks are remembered."""


@dataclass
class Task:
    """One piece of long work.

    Parameters
    ----------
    kind : str
        diagnosis, add-effects or improve.
    subject : str
        The model's id.
    """

    id: str
    kind: str
    subject: str
    by: str
    state: str = "running"
    job: Job | None = None
    result_url: str | None = None
    problem: ApiError | None = None
    done: asyncio.Event = field(default_factory=asyncio.Event)

    def take(self, job: Job) -> None:
        """The job that is being done for it now."""
        self.job = job

    def public(self) -> dict[str, Any]:
        """What a client sees of it."""
        job = self.job.public() if self.job else {}
        return {
            "id": self.id,
            "kind": self.kind,
            "model_id": self.subject,
            "requested_by": self.by,
            "state": self.state,
            "done": self.state != "running",
            "progress": 1.0 if self.state == "completed" else job.get("progress", 0.0),
            "text": job.get("text", ""),
            "elapsed_s": job.get("elapsed_s", 0.0),
            "time_left_s": job.get("time_left_s") if self.state == "running" else 0.0,
            "result_url": self.result_url,
            "problem": self.problem.body(f"/v1/jobs/{self.id}") if self.problem else None,
        }


class Tasks:
    """Starts long work beside the request that asked for it."""

    def __init__(self, fitting: Fitting) -> None:
        self.fitting = fitting
        self.all: dict[str, Task] = {}
        self._numbers = itertools.count(1)
        self._running: set[asyncio.Task[None]] = set()

    def start(self, kind: str, subject: str, by: str, work: Callable[[Task], Awaitable[str]]) -> Task:
        """Begin; `work` gives the address of the result. A second start of what runs already gives the first one."""
        for task in self.all.values():
            if (task.kind, task.subject, task.state) == (kind, subject, "running"):
                return task
        task = Task(f"J{next(self._numbers)}", kind, subject, by)
        self.all[task.id] = task
        for old in [known.id for known in self.all.values() if known.state != "running"][: -KEPT or None]:
            del self.all[old]
        running = asyncio.create_task(self._follow(task, work))
        self._running.add(running)
        running.add_done_callback(self._running.discard)
        return task

    async def _follow(self, task: Task, work: Callable[[Task], Awaitable[str]]) -> None:
        try:
            task.result_url = await work(task)
            task.state = "completed"
        except ApiError as error:
            task.state, task.problem = ("cancelled" if error.code == "cancelled" else "failed"), error
        except Exception as error:
            log.exception("%s of %s failed", task.kind, task.subject)
            detail = f"{type(error).__name__}. Nothing was lost. See logs/api.log."
            task.state, task.problem = "failed", ApiError(500, "internal", "Something unforeseen went wrong", detail)
        finally:
            task.done.set()

    def get(self, task_id: str) -> Task:
        """A task by its id."""
        task = self.all.get(task_id)
        if task is None:
            raise NotFoundError("job", task_id, "A restart of the service forgets jobs; ask for the result again.")
        return task

    def cancel(self, task: Task) -> None:
        """End the work; what is done already stays done."""
        if task.state == "running" and task.job is not None:
            self.fitting.cancel(task.job)

    async def close(self) -> None:
        """Let everything go."""
        for running in list(self._running):
            running.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)
