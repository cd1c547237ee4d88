"""Free effects: what is added where no effect of the library explains a record.

The library's effects ask "is it this?"; free ones describe. They are tried only where structure is left, on the model
without the library's effects of the muscle and on the one with them; left-out blocks choose, as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import residual_structure, vetoed
from stimrig.identify.diagnosis.search import (
    MOST,
    EffectSearch,
    Progress,
    scan,
    search_effects,
    silent,
    without_effect,
)
from stimrig.identify.diagnosis.verdict import Verdict, judge, judge_free
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import Effect, find_effect, registry
from stimrig.identify.estimation.effect_fit import WORTHLESS, Candidate, replaced_by
from stimrig.identify.estimation.joint import Fitted, solve
from stimrig.identify.estimation.left_out import LeftOut, difference, leave_out
from stimrig.identify.estimation.samples import Raw, fitted_rows
from stimrig.identify.noise import WHITE

ZERO = {"free_zero": "baseline_drift"}
"""A free effect, and the one of the library that nothing foretells and that may look like it."""


@dataclass(frozen=True)
class Chain:
    """Models from a base on, each with one free effect more."""

    models: tuple[Fitted, ...]
    left_out: tuple[LeftOut, ...]
    added: tuple[str, ...] = ()

    def with_(self, fitted: Fitted, unseen: LeftOut, effect: str) -> Chain:
        """With one model more."""
        return Chain((*self.models, fitted), (*self.left_out, unseen), (*self.added, effect))


def searched(
    grid: Grid, raw: Raw, progress: Progress | None = None, *, most: int = MOST, structure: Sequence[str] = ()
) -> tuple[EffectSearch, Verdict]:
    """The search for effects of the library, and then, where structure is left, for free ones; and its verdict.

    As `search_effects`. A free effect is no name: where one is needed, the verdict stays that structure is left.
    """
    say = progress or silent
    rows = fitted_rows(grid, None)
    search = search_effects(grid, raw, rows, lambda done, text: say(0.7 * done, text), most=most, structure=structure)
    verdict = judge(search)
    named = verdict.kind == "effect_missing" and not verdict.objections
    if most == 0 or verdict.kind == "nothing_missing" or (named and not search.residuals[-1].left):
        return search, verdict
    freely = explain_freely(search, lambda done, text: say(0.7 + 0.25 * done, text), named)
    if not freely.free:
        return search, verdict
    return freely, judge_free(freely, verdict, named)


def explain_freely(search: EffectSearch, progress: Progress | None = None, named: bool = False) -> EffectSearch:
    """The search with free effects, where they predict left-out blocks better than what it found; else as it was.

    Parameters
    ----------
    search : EffectSearch
        In whose last model structure is left.
    progress : callable or None
        As `search_effects` takes it.
    named : bool
        Whether what the search found is named, and so stays whatever else is added.
    """
    say = progress or silent
    if named:
        whole = _extended(_found(search), say, thresholds.FURTHER_FREE)
        return _with_chain(search, whole, [*search.added, *whole.added]) if whole.added else search
    kept = [effect for effect in search.added if not find_effect(effect).predictable and not find_effect(effect).band]
    best = _extended(_with_only(search, kept), lambda done, text: say(0.5 * done, text))
    names = kept
    if (
        len(kept) < len(search.added)
        and difference(best.left_out[-1], search.left_out[-1]).errors > thresholds.NO_WORSE
    ):
        other = _extended(_found(search), lambda done, text: say(0.5 + 0.5 * done, text))
        if difference(best.left_out[-1], other.left_out[-1]).errors >= thresholds.BETTER:
            best, names = other, search.added
    gained = difference(search.left_out[-1], best.left_out[-1])
    if not best.added or not gained.errors >= thresholds.BETTER:
        return search
    return _with_chain(search, best, [*names, *best.added])


def _found(search: EffectSearch) -> Chain:
    """The chain of the library's effects, as the search left it."""
    return Chain(tuple(search.chain), tuple(search.left_out))


def _with_only(search: EffectSearch, kept: Sequence[str]) -> Chain:
    """The chain of models with only some of the effects that were added."""
    if kept == search.added:
        return _found(search)
    last = search.last
    for effect in search.added:
        if effect not in kept:
            last = without_effect(last, effect)
    models = [last]
    for effect in reversed(kept):
        models.append(without_effect(models[-1], effect))
    return Chain(tuple(models[::-1]), tuple(leave_out(one) for one in reversed(models)))


def _extended(chain: Chain, progress: Progress, first: tuple[float, float] = thresholds.FIRST_FREE) -> Chain:
    """With the free effects that left-out blocks ask for, and against which held-out rows do not speak."""
    for number in range(thresholds.MOST_FREE):
        base, unseen = chain.models[-1], chain.left_out[-1]
        listed = [effect for effect in registry().values() if _applicable(effect, base)]
        share = number / thresholds.MOST_FREE
        tried = scan(base, listed, WORTHLESS, [], lambda done, text, at=share: progress(at + 0.5 * done, text))
        best = _best(unseen, tried, *(thresholds.FURTHER_FREE if chain.added else first))
        if best is None or vetoed(base, best[0]):
            break
        chain = chain.with_(*best)
    return chain


def _applicable(effect: Effect, base: Fitted) -> bool:
    """Whether a free effect can stand beside those of a model: free lags take the place of every other speed law.

    A zero that drifts is tried, too: a zero that follows from the work must gain more.
    """
    if effect.id in ZERO.values():
        return effect.id not in dict(base.effects)
    return bool(effect.shape) and effect.id not in dict(base.effects) and not replaced_by(base.effects, effect.forms)


def _best(
    unseen: LeftOut, tried: Sequence[Candidate], errors: float, least: float
) -> tuple[Fitted, LeftOut, str] | None:
    """The candidate that predicts left-out blocks best, its error there and its effect."""
    able, gains = [], {one.effect.id: one.gain for one in tried}
    for one in tried:
        if one.effect.shape is None or gains.get(ZERO.get(one.effect.id, ""), -np.inf) > one.gain:
            continue
        if one.gain < thresholds.NEXT_MARGIN:
            break
        for fitted in _twins(one.fitted):
            own = leave_out(fitted)
            seen = difference(unseen, own)
            if seen.errors >= errors and seen.gain >= least:
                able.append((seen.gain, fitted, own, one.effect.id))
    return max(able, key=lambda found: found[0])[1:] if able else None


def _twins(fitted: Fitted) -> list[Fitted]:
    """A fit; and, where its slow noise may have taken up structure, the same with noise that is held white."""
    if fitted.noise.held or fitted.noise.ar1 < thresholds.TAKES_UP:
        return [fitted]
    return [fitted, solve(fitted.problem, fitted.theta, WHITE)]


def _with_chain(search: EffectSearch, chain: Chain, names: list[str]) -> EffectSearch:
    """The search that ends with this chain. Where an effect is no longer there, round 1 says what was refused."""
    kept = [search.added.index(name) for name in names if name not in chain.added]
    refused = slice(len(kept), None) if len(kept) == len(search.added) else slice(1)
    return replace(
        search,
        added=names,
        chain=list(chain.models),
        left_out=list(chain.left_out),
        residuals=[residual_structure(fitted, search.quiet) for fitted in chain.models],
        rounds=[*(search.rounds[place] for place in kept), *search.rounds[refused]],
        margins=[*(search.margins[place] for place in kept), *search.margins[refused]],
        losses={},
        free=list(chain.added),
    )
