"""Probabilities of what a diagnosis states: logistic functions of what the search found.

Their weights were fitted on records with known truth (`python -m bench.calibration`), and no score speaks against a
statement where it should speak for it: all weights are positive. docs/diagnosis.md says how well they hold.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files

import numpy as np

from stimrig.identify.diagnosis.objections import at_bounds
from stimrig.identify.diagnosis.search import EffectSearch, Step, only_at_work
from stimrig.identify.estimation.effect_fit import effect_names
from stimrig.identify.estimation.left_out import difference, hold_out

Scores = dict[str, float]
"""What speaks for a statement, by name; larger values make it more probable."""
LARGEST_ODDS = 5.0
"""Largest logarithm of the odds against rivals that counts."""
USUAL_CONTRADICTION = 0.15
"""Of models that lack nothing: the median over records; it stands where there are too few parts to compare."""


@cache
def weights() -> Mapping[str, Scores]:
    """The weights of the scores of each statement; "" is the constant."""
    text = (files("stimrig.identify.diagnosis") / "probability.json").read_text("utf-8")
    return json.loads(text)["weights"]


def probability(statement: str, scores: Scores) -> float:
    """Probability, 0 to 1, of a statement, one of `weights`, from its scores."""
    return logistic(weights()[statement], scores)


def logistic(known: Scores, scores: Scores) -> float:
    """Probability, 0 to 1, by these weights."""
    return float(1.0 / (1.0 + np.exp(-known[""] - sum(known[name] * value for name, value in scores.items()))))


def scores_of_remainder(search: EffectSearch) -> Scores:
    """Return what speaks for something that is missing beside the effects which are named."""
    remainder = search.remainder
    held_out = remainder.held_out.ratio if remainder.held_out else 1.0
    return {
        "structure": float(remainder.structure),
        "terms": float(bool(search.names("free"))),
        "held out": float(np.log(np.clip(held_out, 0.5, 6.0))),
        "work and rest": float(np.log1p(max(remainder.ratio, 0.0))),
        "parts": float(np.log(np.clip(remainder.contradiction or USUAL_CONTRADICTION, 0.02, 50.0))),
        "open": float(np.log1p(np.clip(remainder.open_gain, 0.0, 300.0))),
    }


def scores_of_effect(search: EffectSearch, before: Step, step: Step, share: float, objected: bool) -> Scores:
    """Return what speaks for an effect that a search added; `share`: its share of probability among its rivals.

    The log evidence, the fall of the left-out error, a resemblance to an earlier effect and the rules for structure had
    no weight beside these: the search has asked for them already.
    """
    effect = str(step.added)
    remaining = scores_of_remainder(search)
    unseen = difference(hold_out(before.searched), hold_out(step.searched))
    return {
        "unseen": float(np.clip(unseen.gain, -0.5, 2.0)),
        "rivals": float(np.clip(np.log(share / max(1.0 - share, 1e-9)), -LARGEST_ODDS, LARGEST_ODDS)),
        "first": -float(any(name not in search.in_samples for name in effect_names(before.searched))),
        "at rest": -float(only_at_work(search.quiet, step.searched, effect)),
        "no objection": -float(objected),
        "within bounds": -float(bool(at_bounds(step.searched, effect))),
        "error": float(np.log(np.clip(before.searched.rms_nm / search.remainder.white_nm, 1.0, 30.0))),
        **{f"no {name}": -remaining[name] for name in ("terms", "held out", "work and rest", "parts")},
    }
