"""The table of a diagnosis: each change of the model that was tried, what it would bring, and what becomes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.conclusion import PROBABLE
from stimrig.identify.diagnosis.search import EffectSearch, Step, helpful
from stimrig.identify.diagnosis.verdict import Verdict
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.effect_fit import Candidate, effect_names
from stimrig.identify.estimation.left_out import Difference, difference, leave_out
from stimrig.identify.estimation.solve import Fitted

NO_CHANGE = "no change"
ADD, OPEN, REFUSED = "add", "cannot decide", "refused"
"""What becomes of a change."""
MOST_COMPARED = 4
"""Refused effects, the likeliest first, whose left-out error is computed: each takes as long as a fit."""
MOST_STRETCHES = 500
"""A longer record is looked at in longer steps."""
MOST_OF_IT = 0.5
"""Share of an effect's improvement that falls in the seconds which drive it."""


def table_of(search: EffectSearch, verdict: Verdict, like: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Return the changes: none, each effect that was found, then each that was refused, best first.

    Each has `effect` (None: no change), `name`, `parameters` (how many it adds), `change_percent` of the error on
    left-out blocks and its `sd_percent`, `probability`, the `seconds` of the record that drive it, `status` and the
    `reason` of the status. Values that were not asked for are None. `like`: for each free effect, the effects of the
    library that act as it does.
    """
    rows = [_row(None, NO_CHANGE, None, 0) | {"probability": None if search.names("free") else verdict.nothing}]
    supported, against = helpful(search)
    vetoed = {row["effect"]: row["reason"] for row in against}
    for before, step in pairwise(search.steps):
        effect = str(step.added)
        chance, why = verdict.probabilities.get(effect), vetoed.get(effect) or verdict.objections.get(effect) or ""
        status = ADD if step in supported else OPEN
        if chance is not None and (chance < PROBABLE or (why and status == ADD)):
            status, why = OPEN, why or "Other effects, or a cause outside the library, explain the record as well."
        why = why or " ".join(_instead(search, name) for name in like.get(effect, ()))
        row = _of_step(before, step) | {"probability": chance}
        rows.append(row | {"status": status, "reason": why})
    for before, step in search.open:
        chance, why = verdict.doubted[str(step.added)], "More probably it is not there."
        rows.append(_of_step(before, step) | {"probability": chance, "status": OPEN, "reason": why})
    listed, compared = {row["effect"] for row in rows}, 0
    for candidate in search.rounds[-1] if search.rounds else ():
        if candidate.effect.id in listed or candidate.effect.id in effect_names(search.last):
            continue
        change = None
        if candidate.gain > 0.0 and compared < MOST_COMPARED and not search.names("free"):
            change, compared = difference(search.steps[-1].left_out, leave_out(candidate.fitted)), compared + 1
        row = _row(candidate.effect.id, candidate.effect.name, change, len(candidate.form.parameters))
        rows.append(row | {"status": REFUSED, "reason": reason_against(search, candidate)})
    return rows


def _instead(search: EffectSearch, effect: str) -> str:
    """Return why an effect of the library is not named where a free effect acts as it does, in words."""
    name = find_effect(effect).name
    tried = next((each for each in (search.rounds or [()])[0] if each.effect.id == effect), None)
    if tried is None:
        return f"{name} was not tried on this record."
    if tried.refusal is None and tried.gain >= search.margin(0):
        return f"{name} in the library's forms predicts left-out parts less well."
    return f"{name} in the library's forms is refused: {reason_against(search, tried)}"


def reason_against(search: EffectSearch, candidate: Candidate) -> str:
    """Return why an effect that was tried in the last round was not added, in words."""
    margin = search.margin(max(len(search.rounds) - 1, 0))
    if candidate.refusal is not None:
        return candidate.refusal
    if candidate.gain <= 0.0:
        return f"The evidence is against it: log evidence changes by {min(candidate.gain, -0.05):+.1f}."
    if candidate.gain < margin:
        return f"Too little evidence: log evidence rises by {candidate.gain:.1f}; at least {margin:g} is required."
    return "Another effect explains the same error better."


def _row(effect: str | None, name: str, change: Difference | None, parameters: int) -> dict[str, Any]:
    row: dict[str, Any] = {
        "effect": effect, "name": name, "parameters": parameters, "change_percent": None, "sd_percent": None,
        "probability": None, "seconds": [], "status": "", "reason": "",
    }  # fmt: skip
    if change is not None and np.isfinite(change.gain):
        ratio = float(np.exp(-change.gain))
        row |= {
            "change_percent": 100.0 * (ratio - 1.0),
            "sd_percent": 100.0 * ratio * change.sd if change.errors else None,
        }
    return row


def _of_step(before: Step, step: Step) -> dict[str, Any]:
    effect = find_effect(str(step.added))
    form = dict(step.searched.written.effects).get(effect.id, effect.forms[0])
    row = _row(effect.id, effect.name, difference(before.left_out, step.left_out), len(form.parameters))
    return row | {"seconds": driving_seconds(before.searched, step.searched)}


def driving_seconds(before: Fitted, after: Fitted) -> list[list[float]]:
    """Return the shortest stretch of a record, in steps of 1 s, in which a model improves by half of what it does.

    Empty where its error on the fitted rows does not fall.
    """
    grid, rows = before.problem.setup.grid, before.problem.setup.fitted
    own_s = grid.time_s - grid.time_s[0]
    bin_s = max(1.0, float(own_s[-1]) / MOST_STRETCHES)
    better = before.residual_nm[rows] ** 2 - after.residual_nm[rows] ** 2
    sums = np.r_[0.0, np.cumsum(np.bincount((own_s[rows] / bin_s).astype(int), better))]
    if not sums[-1] > 0.0:
        return []
    begin, end = np.nonzero(np.triu(sums[None, :] - sums[:, None] >= MOST_OF_IT * sums[-1], 1))
    best = int(np.argmin(end - begin))
    first_s = float(grid.time_s[0])
    return [[first_s + begin[best] * bin_s, first_s + end[best] * bin_s]]
