"""What is done with a record: the verb and its options; and what ends a run. What ends one record only is its row."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.identify.errors import IdentifyError

GOES_ON = "What is done is kept; the same command goes on."
SCHEDULER_GONE = f"the scheduler is gone. {GOES_ON}"


class CohortError(ApiError):
    """The run cannot begin: wrong input, a scheduler that is not there, results of other options.

    `message`: one line: the place, what is wrong, what to do.
    """

    def __init__(self, message: str) -> None:
        super().__init__(422, "cohort", message)


class CutOffError(CohortError):
    """The run began and cannot go on; what was done is kept, and the same command goes on with it."""


AUTO, METHOD = "auto", "maximum-likelihood"


@dataclass(frozen=True)
class Task:
    """One verb with its options, the same for every record."""

    verb: str
    select: str = ""  # the selection's text: a record whose listing leaves it open is judged once it has been read
    method: str = METHOD
    effects: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    software: str = ""  # version of stimrig that asked; a worker of another one refuses

    def document(self) -> dict[str, Any]:
        """The options by which results may be added to results."""
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def of(cls, document: dict[str, Any]) -> Task:
        given: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in document.items()
        }
        return cls(**given)


OPTIONS = tuple(field.name for field in fields(Task))


def differing(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Words on how the options of two runs differ; empty if they don't."""
    names = [name for name in OPTIONS if now.get(name) != before.get(name)]
    return ", ".join(f"{name} {_in_words(before.get(name))}, now {_in_words(now.get(name))}" for name in names)


def _in_words(value: Any) -> str:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value) if value else "none"


def checked(task: Task) -> Task:
    """The task, whose options can be used on some record.

    Raises CohortError: an unknown method or effect, a column that cannot be meant.
    """
    from stimrig.identify.effects import find_effect
    from stimrig.identify.methods import method_of
    from stimrig.identify.records.columns import parsed

    try:
        method_of(task.method)
        for name in task.effects:
            if name != AUTO:
                find_effect(name.partition(":")[0])
        parsed(list(task.columns) or None)
    except IdentifyError as error:
        raise CohortError(str(error)) from error
    return task
