"""A verb with its options, the same for every record of a run."""

from __future__ import annotations

from dataclasses import asdict, dataclass

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

    def options(self) -> dict[str, str]:
        """Return the options in words, as the results hold them."""
        words = {name: value if isinstance(value, str) else ", ".join(value) for name, value in asdict(self).items()}
        return {name: value or "none" for name, value in words.items()}

    def check(self) -> None:
        """Raise CohortError if a method, an effect or a column is unknown."""
        from stimrig.identify.effects import find_effect
        from stimrig.identify.errors import IdentifyError
        from stimrig.identify.methods import method_of
        from stimrig.identify.records.columns import parse_column_map

        try:
            method_of(self.method)
            for name in self.effects:
                find_effect(name.partition(":")[0])
            parse_column_map(list(self.columns) or None)
        except IdentifyError as error:
            raise CohortError(str(error)) from error
