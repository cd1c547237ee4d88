"""What ends a run over a cohort. What ends only one record is a row of the results, never one of these."""

from __future__ import annotations

from stimrig.api.errors import ApiError

GOES_ON = "What is done is kept; the same command goes on."
SCHEDULER_GONE = f"the scheduler is gone. {GOES_ON}"


class CohortError(ApiError):
    """The run cannot begin: wrong input, a scheduler that is not there, results of other options.

    Parameters
    ----------
    message : str
        One line: the place, what is wrong, what to do.
    """

    def __init__(self, message: str) -> None:
        super().__init__(422, "cohort", message)


class CutOffError(CohortError):
    """The run began and cannot go on; what was done is kept, and the same command goes on with it."""
