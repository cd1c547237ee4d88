"""Free effects: what is added where no effect of the library explains a record.

The library's effects ask "is it this?"; free ones describe. They are tried only where structure is left, on the model
without the library's effects of the muscle and on the one with them; left-out blocks choose, as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import (
    MAX_EFFECTS,
    EffectSearch,
    Progress,
    Step,
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
from stimrig.identify.estimation.left_out import Difference, LeftOut, difference, leave_out
from stimrig.identify.estimation.samples import Raw, fitted_rows
from stimrig.identify.estimation.solve import Fitted

ZERO = {"free_zero": "baseline_drift"}
"""A free effect, and the one of the library that nothing foretells and that may look like it."""
MAX_FREE, BEAM = 2, 2
"""Free effects at most; and so many chains of each length, the best on left-out blocks, are extended by a second."""
Chain = tuple[Step, ...]
"""Steps of a search from its base on, the last ones with free effects."""


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
    supported = [str(step.added) for step in helpful(search)[0] if step.origin == "library"]
    named = verdict.kind == "effect_missing" and bool(supported or not search.found)
    error = verdict.held_out_error
    doubted = search.residual.significant or (error is not None and error.ratio > thresholds.NAMED_BUT)
    if named and not doubted:
        return search, verdict
    freely = explain_freely(search, supported, named, lambda done, text: report(0.7 + 0.25 * done, text))
    return freely, judge_free(freely, verdict, named) if freely.names("free") else verdict


def explain_freely(search: EffectSearch, names: Sequence[str], named: bool, progress: Progress) -> EffectSearch:
    """The search with free effects, where they predict left-out blocks better than what it found; else as it was.

    `names`: of its effects the first ones, against which held-out pulses do not speak. `named`: whether they are named;
    then they stay beside free effects. A free effect describes more than a name's own form, so it would often do better
    alone where the name is right.
    """
    whole = tuple(step for step in search.steps if step.origin != "library" or step.added in names)
    unpredictable = [effect for effect in names if not find_effect(effect).predictable and not find_effect(effect).band]
    alone = [] if named or unpredictable == [*names] else [_with_only(search, unpredictable)]
    first = thresholds.BETTER_THAN_ALIKE if named else thresholds.BETTER_IF_DOUBTFUL
    chains = _extended([*alone, whole], progress, first)
    if not named:  # against a model that names nothing it need only be better
        chains = [chain for chain in chains if _better(whole, chain).errors >= thresholds.BETTER]
    if not chains:
        return search
    kept = sum(step.origin == "library" for step in chains[-1])
    refused = search.refused if kept == len(search.found) else search.rounds[0]
    return replace(search, steps=list(chains[-1]), refused=refused)


def _with_only(search: EffectSearch, retained: Sequence[str]) -> Chain:
    """The steps with only some of the library's effects that were added."""
    last = search.last
    for effect in search.names("library"):
        if effect not in retained:
            last = without_effect(last, effect)
    models = [last]
    for effect in reversed(retained):
        models.append(without_effect(models[-1], effect))
    given = [step for step in search.steps if step.origin != "library"]
    given[-1] = replace(given[-1], searched=models.pop())
    found = [step for _, step in search.found if step.added in retained]
    return (*given, *(replace(step, searched=model) for step, model in zip(found, reversed(models), strict=True)))


def _extended(bases: Sequence[Chain], progress: Progress, first: float) -> list[Chain]:
    """The best chain with one free effect, with two, …, as far as left-out blocks ask for more.

    The likeliest few of each length are extended: which effect is best alone does not say which is best beside others.
    Held-out rows choose none: where they speak against the best, it ends there.
    """
    best_chains: list[Chain] = []
    beam = list(bases)
    for number in range(MAX_FREE):
        longer: list[Chain] = []
        for at, chain in enumerate(beam):
            share, part = (number + at / len(beam)) / MAX_FREE, 1.0 / len(beam) / MAX_FREE
            longer += _longer(chain, partial(_within, progress, share, part), first)
        if not longer:
            break
        longer.sort(key=lambda chain: -_better(bases[0], chain).gain)
        best = _likeliest(longer)
        if best_chains and not _predicts_better(best_chains[-1], best, thresholds.BETTER_THAN_ALIKE):
            break
        links = [pair for pair in pairwise(best) if pair[1].origin == "free"]
        if any(vetoed(before.searched, step.searched) for before, step in links):
            break
        best_chains.append(best)
        unlike: dict[str | None, Chain] = {}  # of each effect its best form
        for chain in longer:
            unlike.setdefault(chain[-1].added, chain)
        beam, first = [*unlike.values()][:BEAM], thresholds.BETTER_THAN_ALIKE
    return best_chains


def _likeliest(chains: Sequence[Chain]) -> Chain:
    """Pick among the chains that left-out blocks cannot separate from the first: fewest names, then likeliest.

    Likelihoods are compared where the noise is of one kind.
    """
    white_only = chains[0][-1].searched.noise.white_only
    near = [
        chain
        for chain in chains
        if chain[-1].searched.noise.white_only == white_only and _better(chain, chains[0]).errors < thresholds.BETTER
    ]
    return min(near, key=lambda chain: (len(chain), -chain[-1].searched.log_evidence))


def _within(progress: Progress, begin: float, part: float, done: float, text: str) -> None:
    progress(begin + part * done, text)


def _better(before: Chain, after: Chain) -> Difference:
    """Compare the left-out errors of the last models of two chains."""
    return difference(before[-1].left_out, after[-1].left_out)


def _predicts_better(before: Chain, after: Chain, required: float) -> bool:
    """Return True if the left-out error falls by so many standard errors, and by what is worth a free effect."""
    comparison = _better(before, after)
    return comparison.errors >= required and comparison.gain >= thresholds.FREE_FALL


def _longer(chain: Chain, progress: Progress, required: float) -> list[Chain]:
    """A chain with each free effect more that left-out blocks ask for."""
    base = chain[-1].searched
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
        model = replace(fitted, problem=candidate.fitted.problem)
        step = Step(candidate.effect.id, model, "free", renews=chain[0].renews, known=left_out)
        if _predicts_better(chain, (*chain, step), required):
            accepted[number] = (*chain, step)
    return [accepted[number] for number in sorted(accepted)]


def _applicable(effect: Effect, base: Fitted) -> bool:
    """Return True if a free effect fits beside those of a model: free lags replace every other speed law.

    A zero that drifts is tried, too: a zero that follows from the work must gain more.
    """
    if effect.id in ZERO.values():
        return effect.id not in dict(base.effects)
    return bool(effect.shape) and effect.id not in dict(base.effects) and not replaced_by(base.effects, effect.forms)
