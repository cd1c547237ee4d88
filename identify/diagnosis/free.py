"""Free effects: terms that are added where no effect of the library explains a record.

The library's effects ask "is it this?"; terms describe. They are tried only where structure is left. One derivative of
the model by the sizes of all terms at zero tells what each would gain; the most promising are fitted, and the likeliest
one stays. Left-out blocks then say how many terms stay. The noise is held as the rests show it: slow noise of any size
would take up what a term is to describe, and ask for the increments alone.
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
from stimrig.identify.diagnosis.verdict import Verdict, judge, judge_free, leaves_more
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import registry
from stimrig.identify.effects.base import Effect, replaced_by
from stimrig.identify.effects.terms import tried_at
from stimrig.identify.estimation.left_out import Difference, difference
from stimrig.identify.estimation.rests import zero_scatter_nm
from stimrig.identify.estimation.samples import Raw, fitted_rows
from stimrig.identify.estimation.solve import LARGEST_SLOPE, Fitted, solve, solve_scaled, start_from
from stimrig.identify.noise import WHITE, beside_zero
from stimrig.identify.problem.problem import Problem

MAX_TERMS, FITTED_TERMS = 6, 5
"""Terms at most; and so many, of those that promise most, are fitted in each round."""
ZERO_MEMORY_S = 20.0
"""Memory of a zero that wanders."""
STEPS = 5
"""Steps of the search by which the terms of a round are compared; the likeliest one is then fitted to its end."""
RIVALS = 2
"""Terms kept beside the chosen one of a round: its likeliest rivals."""
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
    supported = helpful(search)[0]
    named = verdict.kind == "effect_missing" and bool(supported[-1].origin == "library" or not search.found)
    if named and not leaves_more(search, verdict):
        return search, verdict
    freely = explain_freely(search, supported if named else (), lambda done, text: report(0.7 + 0.25 * done, text))
    if not freely.names("free"):
        return search, verdict
    return freely, judge_free(freely, verdict, named and freely.steps[: len(supported)] == [*supported])


def explain_freely(search: EffectSearch, named: Sequence[Step], progress: Progress) -> EffectSearch:
    """The search with terms, where they describe the record better than what it found; else as it was.

    `named`: its steps with effects that are named, empty where none is. Terms are looked for beside them, and on the
    model with what the samples show alone. A model without the names takes their place only where they explain less
    than half of what it explains, and where it predicts left-out blocks better.
    """
    before, best = _in_held_noise(tuple(search.steps)), search
    alone = [step for step in search.steps if step.origin != "library"]
    for base in [named, alone] if len(named) > len(alone) else [alone]:
        if base[-1].searched.noise.band:  # a wave that terms, in white noise, would have to describe
            continue
        chain = _extended(tuple(base), progress)
        own, other = _better(base, chain), _better(before, chain)
        if len(chain) == len(base) or own.gain < thresholds.FREE_FALL:
            continue
        if base is alone and own.errors >= thresholds.BETTER_IF_DOUBTFUL:
            start = _in_held_noise(tuple(base))[-1].searched.log_evidence
            names, terms = (each[-1].searched.log_evidence - start for each in (before, chain))
            replaces = not named or (other.errors >= thresholds.BETTER and names < thresholds.NAMES_SHARE * terms)
        else:
            replaces = base is named and own.errors >= thresholds.BETTER_THAN_ALIKE
        if replaces:
            whole = len(base) == len(search.steps)
            best = replace(search, steps=list(chain), refused=search.refused if whole else search.rounds[0])
            before = _in_held_noise(chain)
    return best


def _in_held_noise(chain: Chain) -> Chain:
    """The chain, the last model of which was searched again with white noise, beside what the rests show of the zero.

    A zero that moves is no white noise: terms would take it up.
    """
    last = chain[-1].searched
    setup = last.problem.setup
    fitted = last if last.noise.held else solve(last.problem, last.theta, WHITE)
    wander = zero_scatter_nm(setup.grid, setup.fitted, fitted.residual_nm)
    noise = WHITE
    if wander > thresholds.WANDERS * fitted.rms_nm:
        noise = beside_zero(wander, fitted.rms_nm, ZERO_MEMORY_S, setup.grid.step_s)
    if noise.share or fitted.noise.share:
        fitted = solve(last.problem, fitted.theta, noise)
    return (*chain[:-1], replace(chain[-1], searched=fitted, known=None))


def _extended(base: Chain, progress: Progress) -> Chain:
    """The base with the terms that left-out blocks ask for; of chains that predict them about equally the shortest."""
    chains = [base]
    for number in range(MAX_TERMS):
        chains[-1] = _in_held_noise(chains[-1])
        last = chains[-1][-1].searched
        starts = _promising(last)

        def fit(at: int, before: Fitted = last, listed: Sequence[Start] = starts) -> Fitted:
            """Without the problem: it holds functions, which cannot be sent between processes."""
            return replace(_with_term(before, *listed[at], STEPS), problem=None)  # type: ignore

        fits: list[Fitted] = []
        for at, fitted in side_by_side(fit, len(starts)):
            progress((number + len(fits) / len(starts)) / MAX_TERMS, f"tried {starts[at][0].name.lower()}")
            fits.append(replace(fitted, problem=_problem(last, [starts[at][0]])))
        best = max(fits, key=lambda fitted: fitted.log_evidence, default=last)
        best = solve(best.problem, best.theta, best.noise)
        if best.log_evidence < last.log_evidence + thresholds.TERM_MARGIN:
            break
        name = best.effects[-1][0]
        others = [fitted for fitted in fits if fitted.effects[-1][0] != name]
        others.sort(key=lambda fitted: -fitted.log_evidence)
        step = Step(name, best, "free", renews=base[0].renews, others=tuple(others[:RIVALS]))
        chains.append((*chains[-1], step))
    allowed: list[Chain] = []  # held-out pulses speak against none of them, compared with each shorter one
    for chain in chains:
        if not any(vetoed(shorter[-1].searched, chain[-1].searched) for shorter in allowed):
            allowed.append(chain)
    gains = [_better(chains[0], chain).gain for chain in allowed]
    near = next(chain for chain, gain in zip(allowed, gains, strict=True) if gain >= max(gains) - thresholds.NEAR)
    return (*base, *near[len(base) :])  # the base as it was searched


def _promising(base: Fitted) -> list[Start]:
    """The terms that promise the largest gains of log-likelihood by one step from the model, the best lag of each."""
    terms = [effect for effect in registry().values() if effect.shape and effect.id not in dict(base.effects)]
    present = sum(form.stage == "term" for _, form in base.effects)
    if not terms or present >= MAX_TERMS or replaced_by(base.effects, terms[0].forms):
        return []
    tried = [(effect, value) for effect in terms for value in tried_at(effect.forms[0])]
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
        best.setdefault(
            effect.id, (effect, dict(zip(names, (float(np.clip(size[place], -1.0, 1.0)), value), strict=False)))
        )
    return [*best.values()][:FITTED_TERMS]


def _problem(base: Fitted, terms: Sequence[Effect]) -> Problem:
    return Problem(base.problem.setup, [*base.effects, *((effect.id, effect.forms[0]) for effect in terms)])


def _with_term(base: Fitted, effect: Effect, values: dict[str, float], max_steps: int) -> Fitted:
    problem = _problem(base, [effect])
    start = start_from(problem, base, {len(base.effects): values})
    while not np.max(np.abs(problem.run(start, derivatives=True)[1])) < LARGEST_SLOPE:  # type: ignore
        start[problem.chosen[-1].first] *= 0.3  # the torque ran away
    return solve(problem, start, base.noise, max_steps=max_steps)


def _better(before: Sequence[Step], after: Sequence[Step]) -> Difference:
    """Compare the left-out errors of the last models of two chains."""
    return difference(before[-1].left_out, after[-1].left_out)
