"""A job: long work with progress, which can be cancelled and whose result is awaited."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.logs import current_test

FIT_TOGETHER = "fit-recordings"
"""Kind of a job whose subject is a participant and not a model."""
LEAST_SHARE = 0.05
"""Share done before the remaining time is estimated."""


@dataclass(eq=False)
class Job:
    """A verb that a worker process does, or work of several such jobs, one after the other.

    `urgent`: it goes before all others. `on_progress`: called on each progress.
    """

    kind: str
    arguments: dict[str, Any] = field(default_factory=dict)
    urgent: bool = False
    on_progress: Callable[[Job], None] | None = None
    # of a job that a person asked for, and that REST lists
    id: str = ""
    subject: str = ""
    request: Any = None
    part: Job | None = None
    """The job in a worker process that this one awaits now."""
    state: str = "queued"  # queued, running, completed, failed or cancelled
    progress: float = 0.0
    text: str = ""
    started_s: float | None = None
    expected_s: float = math.inf
    """Estimated total time: the least of all estimates so far."""
    result: asyncio.Future[Any] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    test_id: str | None = field(default_factory=current_test.get)

    def __post_init__(self) -> None:
        # an error that nobody awaits is in the log already
        self.result.add_done_callback(lambda done: done.cancelled() or done.exception())

    @property
    def elapsed_s(self) -> float:
        """Time since it began; 0 while it is queued."""
        return 0.0 if self.started_s is None else time.monotonic() - self.started_s

    @property
    def time_left_s(self) -> float | None:
        """Estimated remaining time, which never grows; None before there is an estimate."""
        if self.state != "running" or self.expected_s == math.inf:
            return None
        return max(0.0, self.expected_s - self.elapsed_s)

    def follow(self, part: Job) -> None:
        """Show the progress of another job as its own."""
        self.part = part

    def start(self) -> None:
        """Note that it has begun."""
        self.state, self.started_s = "running", time.monotonic()

    def advance(self, progress: float, text: str) -> None:
        """Take in progress."""
        self.progress, self.text = progress, text
        if progress >= LEAST_SHARE:
            self.expected_s = min(self.expected_s, self.elapsed_s / progress)
        if self.on_progress is not None:
            self.on_progress(self)

    def complete(self, result: Any) -> None:
        """End it with its result."""
        self.state = "completed"
        if not self.result.done():
            self.result.set_result(result)

    def fail(self, error: Exception) -> None:
        """End it with an error."""
        self.state = "cancelled" if isinstance(error, ApiError) and error.code == "cancelled" else "failed"
        if not self.result.done():
            self.result.set_exception(error)

    @property
    def result_url(self) -> str | None:
        """Address of the result of a job that a person asked for, once it is completed."""
        return self.result.result() if self.state == "completed" else None

    @property
    def problem(self) -> ApiError | None:
        """Why a job that a person asked for failed or was cancelled."""
        error = self.result.exception() if self.state in ("failed", "cancelled") else None
        return error if isinstance(error, ApiError) else None

    def progress_document(self) -> dict[str, Any]:
        """Return how far it is, as clients see it."""
        current = self.part or self
        left_s = current.time_left_s
        return {
            "progress": 1.0 if self.state == "completed" else round(current.progress, 3),
            "text": current.text,
            "elapsed_s": round(current.elapsed_s, 1),
            "time_left_s": None if left_s is None else round(left_s, 1),
        }

    def document(self) -> dict[str, Any]:
        """Return a job that a person asked for, as clients see it."""
        of_participant = self.kind == FIT_TOGETHER
        return {
            "id": self.id,
            "kind": self.kind,
            "model_id": None if of_participant else self.subject,
            "participant": self.subject if of_participant else None,
            "state": self.state,
            "done": self.result.done(),
            **self.progress_document(),
            "result_url": self.result_url,
            "problem": self.problem.body(f"/v1/jobs/{self.id}") if self.problem else None,
        }


def cancelled() -> ApiError:
    """Return the error of a job that was cancelled."""
    return ApiError(409, "cancelled", "The job was cancelled", "Start it again if it is still wanted.")
