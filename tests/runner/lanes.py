"""The lanes of `python -m tests`, in the order in which they run: the cheap and telling ones first."""

from __future__ import annotations

import os
from collections.abc import Mapping, Set
from dataclasses import dataclass

from _pytest.mark.expression import Expression

PROCESSORS = os.cpu_count() or 1
TOGETHER = ("--dist", "worksteal", "-n")
FAST = "not wire and not browser and not service and not slow"
ON_POSTGRESQL = ("controller_keys", "idle_lock", "participants", "people", "session", "tracked")


@dataclass(frozen=True)
class Lane:
    """Some of the tests, and how they are run.

    Parameters
    ----------
    marks : pytest's expression of markers.
    processes : how many run them side by side; none: one process, nothing beside it.
    paths : files and folders of tests.
    options : further ones for pytest.
    """

    marks: str
    processes: int = 0
    paths: tuple[str, ...] = ("tests",)
    options: tuple[str, ...] = ()

    def arguments(self, tests: Mapping[str, Set[str]]) -> tuple[str, ...]:
        """What pytest is given: of the tests and their markers only the files that hold some; unknown ones are all."""
        together = (*TOGETHER, str(self.processes)) if self.processes else ()
        files = sorted({test.partition("::")[0] for test, markers in tests.items() if self.holds(test, markers)})
        return (*self.options, "-m", self.marks, *together, *(files or self.paths))

    def holds(self, test: str, markers: Set[str]) -> bool:
        """Whether a test of these markers is run here."""
        here = any(test.startswith((f"{path}/", f"{path}::")) for path in self.paths)
        return here and Expression.compile(self.marks).evaluate(lambda name, **_: name in markers)


LANES = {
    "fast": Lane(FAST, PROCESSORS),
    # the machine to itself: at the limits of real time
    "realtime": Lane("realtime"),
    # what several services share, and what the database decides; `make postgresql` runs all of it there.
    # More processes than processors: tests of the service wait half of their time
    "postgresql": Lane(
        "service and not browser and not wire and not slow and not sqlite",
        PROCESSORS + 2,
        tuple(f"tests/api/test_{name}.py" for name in ON_POSTGRESQL),
        ("--postgresql",),
    ),
    "dear": Lane(f"not wire and not ({FAST})", PROCESSORS + 2),
    # more than two emulated rigs leave too little of two processors to each
    "wire": Lane("wire and not realtime", 2),
}

CAMPAIGNS = {
    "make campaigns": "whole grids, of which one of each kind is run here",
    "make postgresql": "every test of the service on PostgreSQL, of which six files are run here",
    "make pauses": "every test while its processes are stopped and continued at random",
    "make late": "the page's tests with answers that come late and in pieces",
    "make soak": "an hour of recording with fits beside it, of which 30 s are run here",
    "make simulate": "thousands of lives of a rig in simulated time, of which 24 are lived here",
    "make mutation": "changes of the rig's safety code, one by one: which of them no test sees",
    "make bench": "the figures in docs/, against other programs",
}
"""What is not run here, by the command that runs it."""
