"""How fast a person changes from trial to trial, learnt from earlier sessions of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stimrig.identify.tracking.state import QUANTITIES, USUAL, Rates, Values

BELIEVED_SESSIONS = 2.0
"""The usual start and the usual first trend count like this many sessions of the person's own."""
BELIEVED_TRIALS = 12.0
"""The usual steps and turns count like this many trials."""
FIRST = 3
"""Trials from which a session's first trend is taken."""

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
        Each variance is a mean of the usual one and of the person's own, weighted by how many there are. The person's
        own holds the scatter of the trials, too.
    """
    known = [_levels(session) for session in sessions if len(session) >= FIRST]
    if not known:
        return USUAL
    count = len(known)
    starts = np.array([levels[0] for levels in known])
    trends = np.array([(levels[FIRST - 1] - levels[0]) / (FIRST - 1) for levels in known])
    trend = trends.sum(axis=0) / (count + BELIEVED_SESSIONS)
    bends = np.concatenate([np.diff(levels, n=2, axis=0) for levels in known])
    usual = USUAL.turn**2 + 2.0 * USUAL.step**2  # of a bend, which holds one turn and two steps
    own = np.sum(bends**2, axis=0)
    faster = np.sqrt((BELIEVED_TRIALS * usual + own) / ((BELIEVED_TRIALS + len(bends)) * usual))
    return Rates(
        start=_pooled(USUAL.start, starts, count),
        step=faster * USUAL.step,
        trend=trend,
        trend_sd=_pooled(USUAL.trend_sd, trends - trend, count),
        turn=faster * USUAL.turn,
        sessions=count,
    )


def _levels(session: Sequence[Told]) -> np.ndarray:
    """Log gain, µs and log time scale of each trial, shape (N, 3)."""
    values = [[float(trial[name]["value"]) for name in QUANTITIES] for trial in session]
    return np.array([Values(*trial).levels for trial in values])


def _pooled(usual: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
    return np.sqrt((BELIEVED_SESSIONS * usual**2 + np.sum(own**2, axis=0)) / (BELIEVED_SESSIONS + count))
