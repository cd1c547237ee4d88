"""What a step of the check says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

Outcome = Literal["passed", "failed", "not done"]


class Fault(NamedTuple):
    """One thing that may be wrong, and what to do about it: a line each."""

    cause: str
    mend: str


@dataclass(frozen=True)
class Finding:
    """The result of one step.

    `figure`, `bound`: what was measured and what it must be, with units; of a step that was not done `figure` says why.
    `fault`: which of the step's faults it looks like.
    """

    outcome: Outcome
    figure: str
    bound: str = ""
    fault: str = ""


def passed(figure: str, bound: str = "") -> Finding:
    return Finding("passed", figure, bound)


def failed(fault: str, figure: str, bound: str = "") -> Finding:
    return Finding("failed", figure, bound, fault)


def not_done(why: str) -> Finding:
    return Finding("not done", why)
