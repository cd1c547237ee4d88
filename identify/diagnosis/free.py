"""Free effects: terms that are added where no effect of the library explains a record.

The library's effects ask "is it this?"; terms describe. They are tried only where structure is left. One derivative of
the model by the sizes of all terms at zero tells what each would gain; the most promising are fitted, and the likeliest
one stays. Left-out blocks then say how many terms stay. The noise is held white: slow noise would take up what a term
is to describe, and ask for the increments alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import (
    MAX_EFFECTS,
    EffectSearch,
    Progress,
    Step,
    helpful,
    search_effects,
    silent,
)
from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.diagnosis.verdict import Verdict, judge, judge_free
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import find_effect, registry
from stimrig.identify.effects.base import Effect, replaced_by
from stimrig.identify.effects.terms import tried_at
from stimrig.identify.estimation.left_out import Difference, difference
from stimrig.identify.estimation.samples import Raw, fitted_rows
from stimrig.identify.estimation.solve import Fitted, solve, solve_scaled, start_from
from stimrig.identify.noise import WHITE
from stimrig.identify.problem.problem import Problem

MAX_TERMS, FITTED_TERMS = 6, 5
"""Terms at most; and so many, of those that promise most, are fitted in each round."""
Chain = tuple[Step, ...]
"""Steps of a search from its base on, the last ones with terms."""
Start = tuple[Effect, dict[str, float]]
"""A term and the values from which it is fitted."""


def searched(
    grid: Grid,
    raw: Raw,
    progress: Progress | None = None,
    *,
    rows: np.ndarray | None = None,
    max_effects: int = MAX_EFFECTS,
    structure: Sequence[str] = (),
) -> tuple[EffectSearch, Verdict]:
    """The search for effects of the library, and then, where structure is left, for terms; and its verdict.

    As `search_effects`; by default on all rows that may be fitted. A term is no name: where one is needed, the verdict
    stays that structure is left.
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
    """The search with terms, where they predict left-out blocks better than what it found; else as it was.

    `names`: of its effects the first ones, against which held-out pulses do not speak. `named`: whether they are named;
    then they stay beside terms. Where nothing is named, only what was seen in the samples and a moving zero stay.
    """
    kept = [name for name in names if named or _follows_no_pulse(find_effect(name))]
    base = _with_only(search, kept)
    chain = _extended(base, progress)
    required = thresholds.BETTER_THAN_ALIKE if named else thresholds.BETTER_IF_DOUBTFUL
    if len(chain) == len(base) or not _predicts_better(search.steps[-1:], chain, required):
        return search
    if vetoed(search.last, chain[-1].searched):
        return search
    return replace(
        search, steps=list(chain), refused=search.refused if len(kept) == len(search.found) else search.rounds[0]
    )


def _follows_no_pulse(effect: Effect) -> bool:
    return not effect.predictable and not effect.sporadic


def _with_only(search: EffectSearch, retained: Sequence[str]) -> Chain:
    """The steps with only some of the library's effects that were added, each fitted from the one before."""
    given = [step for step in search.steps if step.origin != "library"]
    for _, step in search.found:
        if step.added in retained:
            if dict(step.searched.effects).keys() != {*dict(given[-1].searched.effects), str(step.added)}:
                form = dict(step.searched.effects)[str(step.added)]
                before = given[-1].searched
                problem = Problem(before.problem.setup, [*before.effects, (str(step.added), form)])
                values = {len(before.effects): step.searched.parameters_of(str(step.added))}
                step = replace(step, searched=solve(problem, start_from(problem, before, values), before.noise))
            given.append(step)
    return tuple(given)


def _extended(base: Chain, progress: Progress) -> Chain:
    """The base with the terms that left-out blocks ask for; of chains that predict them about equally the shortest."""
    first = base[-1]
    last = solve(first.searched.problem, first.searched.theta, WHITE)
    chains = [(*base[:-1], replace(first, searched=last, known=None))]
    for number in range(MAX_TERMS):
        starts = _promising(last)

        def fit(at: int, before: Fitted = last, listed: Sequence[Start] = starts) -> Fitted:
            """Without the problem: it holds functions, which cannot be sent between processes."""
            return replace(_with_term(before, *listed[at]), problem=None)  # type: ignore

        fits: list[Fitted] = []
        for at, fitted in side_by_side(fit, len(starts)):
            progress((number + len(fits) / len(starts)) / MAX_TERMS, f"tried {starts[at][0].name.lower()}")
            fits.append(replace(fitted, problem=_problem(last, [starts[at][0]])))
        best = max(fits, key=lambda fitted: fitted.log_evidence, default=last)
        if best.log_evidence < last.log_evidence + thresholds.TERM_MARGIN:
            break
        last = best
        step = Step(best.effects[-1][0], best, "free", renews=base[0].renews)
        chains.append((*chains[-1], step))
    gains = [_better(chains[0], chain).gain for chain in chains]
    near = next(chain for chain, gain in zip(chains, gains, strict=True) if gain >= max(gains) - thresholds.NEAR)
    return (*base, *near[len(base) :])


def _promising(base: Fitted) -> list[Start]:
    """The terms that promise the largest gains of log-likelihood by one step from the model, the best lag of each."""
    terms = [effect for effect in registry().values() if effect.shape and effect.id not in dict(base.effects)]
    if not terms or replaced_by(base.effects, terms[0].forms):
        return []
    tried = [(effect, value) for effect in terms for value in tried_at(effect.forms[0].law["driver"])]
    forms = [
        (
            f"{effect.id} {value}",
            replace(
                effect.forms[0], parameters=effect.forms[0].parameters[:1], law=effect.forms[0].law | {"lag": value}
            ),
        )
        for effect, value in tried
    ]
    setup, known = base.problem.setup, base.theta.size
    wide = Problem(setup, [*base.effects, *forms])
    slopes = wide.run(start_from(wide, base, {}), derivatives=True)[1]
    assert slopes is not None
    white = setup.whitened(np.vstack([base.residual_nm, slopes]), base.noise)
    residual, own, new = white[0], white[1 : known + 1], white[known + 1 :]
    shared = own @ new.T
    information = np.sum(new**2, 1) - np.sum(shared * solve_scaled(base.hessian, shared), 0)
    size = (new @ residual) / (information + np.diag(wide.prior[1])[known:])
    gain = 0.5 * size * (new @ residual)
    best: dict[str, Start] = {}
    for place in np.argsort(-gain):
        effect, value = tried[place]
        names = [p.name for p in effect.forms[0].parameters]
        best.setdefault(effect.id, (effect, dict(zip(names, (float(size[place]), value), strict=False))))
    return [*best.values()][:FITTED_TERMS]


def _problem(base: Fitted, terms: Sequence[Effect]) -> Problem:
    return Problem(base.problem.setup, [*base.effects, *((effect.id, effect.forms[0]) for effect in terms)])


def _with_term(base: Fitted, effect: Effect, values: dict[str, float]) -> Fitted:
    problem = _problem(base, [effect])
    return solve(problem, start_from(problem, base, {len(base.effects): values}), base.noise)


def _better(before: Sequence[Step], after: Sequence[Step]) -> Difference:
    """Compare the left-out errors of the last models of two chains."""
    return difference(before[-1].left_out, after[-1].left_out)


def _predicts_better(before: Sequence[Step], after: Sequence[Step], required: float) -> bool:
    """Return True if the left-out error falls by so many standard errors, and by what is worth a free effect."""
    comparison = _better(before, after)
    return comparison.errors >= required and comparison.gain >= thresholds.FREE_FALL
