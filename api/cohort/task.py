"""A verb with its options, the same for every record of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from stimrig.api.cohort.errors import CohortError

METHOD = "maximum-likelihood"


@dataclass(frozen=True)
class Task:
    """One verb with its options: rows are added to rows of an equal task only."""

    verb: str  # fit, diagnose or improve
    select: str = ""
    method: str = METHOD
    effects: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()  # of other tools' tables, as --map gives them
    software: str = ""  # version of stimrig

    def options(self) -> dict[str, Any]:
        """Return the options as JSON holds them."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    def check(self) -> None:
        """Raise CohortError if a method, an effect or a column is unknown."""
        from stimrig.identify.effects import find_effect
        from stimrig.identify.errors import IdentifyError
        from stimrig.identify.methods import method_of
        from stimrig.identify.records.columns import parsed

        try:
            method_of(self.method)
            for name in self.effects:
                if name != "auto":
                    find_effect(name.partition(":")[0])
            parsed(list(self.columns) or None)
        except IdentifyError as error:
            raise CohortError(str(error)) from error


OPTIONS = tuple(field.name for field in fields(Task))


def describe_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Say how the options of two runs differ; empty if they do not."""
    names = [name for name in OPTIONS if now.get(name) != before.get(name)]
    return ", ".join(f"{name} {_in_words(before.get(name))}, now {_in_words(now.get(name))}" for name in names)


def _in_words(value: Any) -> str:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value) if value else "none"
