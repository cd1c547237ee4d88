"""The steps of a check, one file each, in the order of their `ORDER`."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Protocol, cast

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Fault, Finding


class Step(Protocol):
    """A module here.

    `NEEDED`: whether a rig that is sound must have passed it; one that a rig cannot do by its rig file is never
    needed. `FAULTS`: what it can find, by short names.
    """

    ORDER: int
    TITLE: str
    NEEDED: bool
    FAULTS: dict[str, Fault]

    async def look(self, bench: Bench) -> Finding:
        """Do it. Raises NotDone."""
        ...


@cache
def library() -> dict[str, Step]:
    """All steps by their names, in their order."""
    names = [entry.name for entry in pkgutil.iter_modules(__path__)]
    found = {name: cast("Step", importlib.import_module(f"{__name__}.{name}")) for name in names}
    return dict(sorted(found.items(), key=lambda item: item[1].ORDER))


def faults() -> dict[str, Fault]:
    """All faults of all steps, by their names."""
    return {name: fault for step in library().values() for name, fault in step.FAULTS.items()}
