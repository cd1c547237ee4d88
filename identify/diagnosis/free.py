"""Free effects: what is added where no effect of the library explains a record.

The library's effects ask "is it this?"; free ones describe. They are tried only where structure is left, on the model
without the library's effects of the muscle and on the one with them; left-out blocks choose, as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import residual_structure, vetoed
from stimrig.identify.diagnosis.search import (
    MAX_EFFECTS,
    EffectSearch,
    Progress,
    helpful,
    scan,
    search_effects,
    silent,
    without_effect,
)
from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.diagnosis.verdict import Verdict, judge, judge_free
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import Effect, find_effect, registry
from stimrig.identify.effects.base import replaced_by
from stimrig.identify.estimation.candidates import trusted
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.left_out import Difference, LeftOut, difference, leave_out
from stimrig.identify.estimation.samples import Raw, fitted_rows

ZERO = {"free_zero": "baseline_drift"}
"""A free effect, and the one of the library that nothing foretells and that may look like it."""
ANY = (thresholds.BETTER, 0.0)
"""As `FIRST_FREE`, against a model that names nothing."""


@dataclass(frozen=True)
class Chain:
    """Models from a base on, each with one free effect more."""

    models: tuple[Fitted, ...]
    left_out: tuple[LeftOut, ...]
    names: tuple[str, ...]  # of the effects of the library that were found and stay
    added: tuple[str, ...] = ()

    def with_(self, fitted: Fitted, unseen: LeftOut, effect: str) -> Chain:
        """With one model more."""
        return replace(
            self, models=(*self.models, fitted), left_out=(*self.left_out, unseen), added=(*self.added, effect)
        )

    @property
    def links(self) -> list[tuple[Fitted, Fitted]]:
        """Each model with a free effect after the one before it."""
        return list(pairwise(self.models[-len(self.added) - 1 :]))

    def better(self, than: LeftOut) -> Difference:
        """Compare the left-out error of its last model with another one."""
        return difference(than, self.left_out[-1])


def searched(
    grid: Grid,
    raw: Raw,
    progress: Progress | None = None,
    *,
    rows: np.ndarray | None = None,
    max_effects: int = MAX_EFFECTS,
    structure: Sequence[str] = (),
) -> tuple[EffectSearch, Verdict]:
    """The search for effects of the library, and then, where structure is left, for free ones; and its verdict.

    As `search_effects`; by default on all rows that may be fitted. A free effect is no name: where one is needed, the
    verdict stays that structure is left.
    """
    report = progress or silent
    rows = fitted_rows(grid, None) if rows is None else rows
    search = search_effects(
        grid, raw, rows, lambda done, text: report(0.7 * done, text), max_effects=max_effects, structure=structure
    )
    verdict = judge(search)
    if max_effects == 0 or verdict.kind == "nothing_missing":
        return search, verdict
    accepted = _accepted_effects(search)
    named = verdict.kind == "effect_missing" and bool(accepted or not search.added)
    if named and not _doubted(verdict, search.residuals[-1].significant):
        return search, verdict
    freely = explain_freely(search, accepted, named, lambda done, text: report(0.7 + 0.25 * done, text))
    if not freely.free:
        return search, verdict
    return freely, judge_free(freely, verdict, named)


def _accepted_effects(search: EffectSearch) -> list[str]:
    """The effects that were added before the first against which held-out pulses speak."""
    return search.added[: len(helpful(search)[0]) - 1 - len(search.detected)]


def _doubted(verdict: Verdict, structure_left: bool) -> bool:
    """Return True if free effects are to be tried beside named ones."""
    error = verdict.held_out_error
    return structure_left or (error is not None and error.ratio > thresholds.NAMED_BUT)


def explain_freely(search: EffectSearch, names: Sequence[str], named: bool, progress: Progress) -> EffectSearch:
    """The search with free effects, where they predict left-out blocks better than what it found; else as it was.

    `names`: of its effects the first ones, against which held-out pulses do not speak. `named`: whether they are named;
    then they stay beside free effects. A free effect describes more than a name's own form, so it would often do better
    alone where the name is right.
    """
    count = len(names)
    whole = Chain(tuple(search.chain[: count + 1]), tuple(search.left_out[: count + 1]), tuple(names))
    unpredictable = [effect for effect in names if not find_effect(effect).predictable and not find_effect(effect).band]
    alone = [] if named or unpredictable == names else [_with_only(search, unpredictable)]
    stays = whole.left_out[-1]
    first, further = thresholds.FIRST_FREE, thresholds.FURTHER_FREE
    chains = _extended([*alone, whole], progress, further if named else first)
    chains = [chain for chain in chains if _predicts_better(stays, chain, further if named else ANY)]
    return _with_chain(search, chains[-1]) if chains else search


def _with_only(search: EffectSearch, retained: Sequence[str]) -> Chain:
    """The chain of models with only some of the effects that were added."""
    last = search.last
    for effect in search.added:
        if effect not in retained:
            last = without_effect(last, effect)
    models = [last]
    for effect in reversed(retained):
        models.append(without_effect(models[-1], effect))
    models.reverse()
    return Chain(tuple(models), tuple(leave_out(model) for model in models), tuple(retained))


def _extended(bases: Sequence[Chain], progress: Progress, first: tuple[float, float]) -> list[Chain]:
    """The best chain with one free effect, with two, …, as far as left-out blocks ask for more.

    The likeliest few of each length are extended: which effect is best alone does not say which is best beside others.
    Held-out rows choose none: where they speak against the best, it ends there.
    """
    best_chains: list[Chain] = []
    beam = list(bases)
    for number in range(thresholds.MAX_FREE):
        longer: list[Chain] = []
        for at, chain in enumerate(beam):
            share, part = (number + at / len(beam)) / thresholds.MAX_FREE, 1.0 / len(beam) / thresholds.MAX_FREE
            longer += _longer(chain, partial(_within, progress, share, part), first)
        if not longer:
            break
        reference = bases[0].left_out[-1]
        longer.sort(key=lambda chain: -chain.better(reference).gain)
        best = _likeliest(longer)
        if best_chains and not _predicts_better(best_chains[-1].left_out[-1], best, thresholds.FURTHER_FREE):
            break
        if any(vetoed(*link) for link in best.links):  # of the second best, extended, the first was not yet asked about
            break
        best_chains.append(best)
        unlike: dict[str, Chain] = {}  # of each effect its best form
        for chain in longer:
            unlike.setdefault(chain.added[-1], chain)
        beam, first = [*unlike.values()][: thresholds.BEAM], thresholds.FURTHER_FREE
    return best_chains


def _likeliest(chains: Sequence[Chain]) -> Chain:
    """Pick among the chains that left-out blocks cannot separate from the first: fewest names, then likeliest.

    Likelihoods are compared where the noise is of one kind.
    """
    noise_is_fixed = chains[0].models[-1].noise.white_only
    near = [
        chain
        for chain in chains
        if chain.models[-1].noise.white_only == noise_is_fixed
        and chains[0].better(chain.left_out[-1]).errors < thresholds.BETTER
    ]
    return min(near, key=lambda chain: (len(chain.names), -chain.models[-1].log_evidence))


def _within(progress: Progress, begin: float, part: float, done: float, text: str) -> None:
    progress(begin + part * done, text)


def _predicts_better(before: LeftOut, chain: Chain, required: tuple[float, float]) -> bool:
    comparison = chain.better(before)
    return comparison.errors >= required[0] and comparison.gain >= required[1]


def _longer(chain: Chain, progress: Progress, required: tuple[float, float]) -> list[Chain]:
    """A chain with each free effect more that left-out blocks ask for."""
    base, unseen = chain.models[-1], chain.left_out[-1]
    listed: list[Effect] = []
    for effect in registry().values():
        if _applicable(effect, base):
            listed += [replace(effect, forms=(form,)) for form in effect.forms] if effect.shape else [effect]
    tried = scan(base, listed, [], partial(_within, progress, 0.0, 0.6))
    gains = {candidate.effect.id: candidate.gain for candidate in tried}
    promising = [
        candidate
        for candidate in tried
        if candidate.effect.shape
        and candidate.gain
        >= max(thresholds.NEXT_MARGIN, gains.get(ZERO.get(candidate.effect.id, ""), thresholds.NEXT_MARGIN))
    ]

    def judged(number: int) -> tuple[Fitted, LeftOut]:
        """Without the problem: it holds functions, which cannot be sent between processes."""
        fitted = trusted(promising[number].fitted)
        return replace(fitted, problem=None), leave_out(fitted)  # type: ignore

    accepted: dict[int, Chain] = {}
    for done, (number, (fitted, left_out)) in enumerate(side_by_side(judged, len(promising)), start=1):
        candidate = promising[number]
        progress(0.6 + 0.4 * done / len(promising), f"tried {candidate.effect.name.lower()}")
        longer = chain.with_(replace(fitted, problem=candidate.fitted.problem), left_out, candidate.effect.id)
        if _predicts_better(unseen, longer, required):
            accepted[number] = longer
    return [accepted[number] for number in sorted(accepted)]


def _applicable(effect: Effect, base: Fitted) -> bool:
    """Return True if a free effect fits beside those of a model: free lags replace every other speed law.

    A zero that drifts is tried, too: a zero that follows from the work must gain more.
    """
    if effect.id in ZERO.values():
        return effect.id not in dict(base.effects)
    return bool(effect.shape) and effect.id not in dict(base.effects) and not replaced_by(base.effects, effect.forms)


def _with_chain(search: EffectSearch, chain: Chain) -> EffectSearch:
    """The search that ends with this chain. Where an effect is no longer there, round 1 says what was refused."""
    kept_rounds = [search.added.index(name) for name in chain.names]
    refused = slice(len(kept_rounds), None) if len(kept_rounds) == len(search.added) else slice(1)
    return replace(
        search,
        added=[*chain.names, *chain.added],
        chain=list(chain.models),
        left_out=list(chain.left_out),
        residuals=[residual_structure(fitted, search.quiet) for fitted in chain.models],
        rounds=[*(search.rounds[place] for place in kept_rounds), *search.rounds[refused]],
        margins=[*(search.margins[place] for place in kept_rounds), *search.margins[refused]],
        losses={},
        free=list(chain.added),
    )
