"""Errors that end a run over many records. An error of one record is its row."""

from __future__ import annotations

from stimrig.api.errors import ApiError

RESUMABLE = "What is done is kept; the same command goes on."
SCHEDULER_GONE = f"the scheduler is gone. {RESUMABLE}"


class CohortError(ApiError):
    """The run cannot begin: bad input, no scheduler, results of other options.

    `message`: one line: the place, what is wrong, what to do.
    """

    def __init__(self, message: str) -> None:
        super().__init__(422, "cohort", message)


class InterruptedRunError(CohortError):
    """The run began and cannot go on; the same command resumes it."""
