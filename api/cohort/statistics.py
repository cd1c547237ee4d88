"""Figures over a cohort: shares with their intervals, and how well a parameter repeats from session to session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

Z95 = 1.959963984540054


def wilson(count: int, of: int) -> tuple[float, float]:
    """The 95 % interval of a share, by Wilson's score; 0 to 1 of nothing."""
    if of <= 0:
        return 0.0, 1.0
    share, z2 = count / of, Z95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = Z95 / (1 + z2 / of) * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2))
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Repeatability:
    """How a parameter repeats between sessions of the same participant.

    Attributes
    ----------
    participants, sessions : int
        With at least two sessions, and their sessions.
    mean : float
        Over all sessions.
    within_sd : float
        Standard deviation between sessions of one participant, pooled.
    between_sd : float or None
        Standard deviation between participants, the part that sessions don't explain; None with one participant.
    cv_percent : float or None
        `within_sd` of the mean, %; None where values of both signs make it mean nothing.
    icc : float or None
        Intraclass correlation ICC(1), one way, for single sessions of unequal numbers; None with one participant.
    """

    participants: int
    sessions: int
    mean: float
    within_sd: float
    between_sd: float | None
    cv_percent: float | None
    icc: float | None


def repeatability(groups: Sequence[Sequence[float]]) -> Repeatability | None:
    """By one-way analysis of variance over participants with two sessions or more; None where there is none.

    Parameters
    ----------
    groups : sequence of sequence of float
        Values by participant.
    """
    several = [list(group) for group in groups if len(group) > 1]
    if not several:
        return None
    count, sizes = len(several), [len(group) for group in several]
    total = sum(sizes)
    means = [fmean(group) for group in several]
    mean = fmean([value for group in several for value in group])
    within = sum((value - own) ** 2 for group, own in zip(several, means, strict=True) for value in group)
    within /= total - count
    positive = min(min(group) for group in several) > 0 or max(max(group) for group in several) < 0
    cv = 100 * math.sqrt(within) / abs(mean) if positive else None
    if count < 2:
        return Repeatability(count, total, mean, math.sqrt(within), None, cv, None)
    between = sum(size * (own - mean) ** 2 for size, own in zip(sizes, means, strict=True)) / (count - 1)
    usual = (total - sum(size**2 for size in sizes) / total) / (count - 1)
    of_people = max(0.0, (between - within) / usual)
    both = between + (usual - 1) * within
    icc = (between - within) / both if both > 0 else None
    return Repeatability(count, total, mean, math.sqrt(within), math.sqrt(of_people), cv, icc)
