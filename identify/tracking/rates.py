"""How fast a person changes from trial to trial, learnt from earlier sessions of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from identify.tracking.state import QUANTITIES, USUAL, Rates

BELIEVED_SESSIONS = 2.0
"""The usual start and the usual first trend count like this many sessions of the person's own."""
BELIEVED_TRIALS = 12.0
"""The usual steps and turns count like this many trials."""
FIRST = 3
"""Trials from which a session's first trend is taken."""
SDS = 2 * 1.96

Told = Mapping[str, Mapping[str, Any]]


def learn_rates(sessions: Sequence[Sequence[Told]]) -> Rates:
    """The usual rates, corrected by what a person's earlier sessions say.

    Parameters
    ----------
    sessions : sequence of sequences
        For each earlier session its trials in order, each as `levels_of` tells them (`now` of `Step.to_dict`). Sessions
        of fewer than three trials say nothing.

    Returns
    -------
    Rates
        Each variance is a mean of the usual one and of the person's own, weighted by how many there are.
    """
    known = [_levels(session) for session in sessions if len(session) >= FIRST]
    if not known:
        return USUAL
    count = len(known)
    starts = np.array([levels[0] for levels, _ in known])
    trends = np.array([(levels[FIRST - 1] - levels[0]) / (FIRST - 1) for levels, _ in known])
    trend = trends.sum(axis=0) / (count + BELIEVED_SESSIONS)
    bends = np.concatenate([np.diff(levels, n=2, axis=0) for levels, _ in known])
    # A bend holds one turn and two steps, and the noise of three levels, of which the middle one counts twice.
    noise = np.mean(np.concatenate([variance for _, variance in known]), axis=0)
    own = np.maximum(np.sum(bends**2, axis=0) - 6.0 * len(bends) * noise, 0.0)
    usual = USUAL.turn**2 + 2.0 * USUAL.step**2
    faster = np.sqrt((BELIEVED_TRIALS * usual + own) / ((BELIEVED_TRIALS + len(bends)) * usual))
    return Rates(
        start=_pooled(USUAL.start, starts, count),
        step=faster * USUAL.step,
        trend=trend,
        trend_sd=_pooled(USUAL.trend_sd, trends - trend, count),
        turn=faster * USUAL.turn,
        sessions=count,
    )


def _levels(session: Sequence[Told]) -> tuple[np.ndarray, np.ndarray]:
    """Log gain, µs and log time scale of each trial and their variances, both of shape (N, 3)."""
    ends = np.array(
        [[[trial[name][key] for key in ("value", "low", "high")] for name in QUANTITIES] for trial in session]
    )
    for place, name in enumerate(QUANTITIES):
        if not name.endswith("_us"):
            ends[:, place] = np.log(ends[:, place])
    return ends[..., 0], ((ends[..., 2] - ends[..., 1]) / SDS) ** 2


def _pooled(usual: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
    return np.sqrt((BELIEVED_SESSIONS * usual**2 + np.sum(own**2, axis=0)) / (BELIEVED_SESSIONS + count))
