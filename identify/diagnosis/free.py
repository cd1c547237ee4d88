"""Free effects: terms that are added where no effect of the library explains a record.

The library's effects ask "is it this?"; terms describe. They are tried only where structure is left. The likeliest one
of a round stays, and left-out blocks then say how many stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.candidate_terms import MAX_TERMS, fit_terms, fix_noise
from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import (
    EffectSearch,
    Progress,
    Step,
    helpful,
    search_effects,
    silent,
    without_effect,
)
from stimrig.identify.diagnosis.verdict import judge, leaves_more, remainder_of
from stimrig.identify.estimation.left_out import Difference, difference
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.estimation.solve import solve
from stimrig.identify.records.record import Record

RIVALS = 2
"""Terms kept beside the chosen one of a round: its likeliest rivals."""
Chain = tuple[Step, ...]
"""Steps of a search from its base on, the last ones with terms."""


def search_record(record: Record, progress: Progress | None = None, structure: Sequence[str] = ()) -> EffectSearch:
    """Search a record for effects of the library, and then, where structure is left, for terms.

    As `search_effects`, on all rows that may be fitted.
    """
    report = progress or silent
    grid, raw = prepare(record)
    rows = fitted_rows(grid, None)
    search = search_effects(grid, raw, rows, lambda done, text: report(0.7 * done, text), structure=structure)
    search = replace(search, known=remainder_of(search))
    free = _with_terms(search, lambda done, text: report(0.7 + 0.25 * done, text))
    return without_doubted(search if free is search else replace(free, known=remainder_of(free)))


def without_doubted(search: EffectSearch) -> EffectSearch:
    """The search up to the first of its models that, more probably, lacks nothing."""
    for number in range(len(search.steps) - 1):
        if judge(search.from_step(number)).kind == "nothing_missing":
            first, doubted = search.steps[: number + 1], tuple(search.steps[number + 1 :])
            why = "The evidence is for it, but records like this one showed it mostly where it was not there."
            refused = [replace(c, refusal=why) if c.effect.id == doubted[0].added else c for c in doubted[0].tried]
            return replace(search, steps=first, doubted=doubted, refused=tuple(refused))
    return search


def _with_terms(search: EffectSearch, progress: Progress) -> EffectSearch:
    """The search with terms, where its effects leave more than noise."""
    structure, supported = search.remainder.structure, helpful(search)[0]
    if not structure and not search.names("detected", "library"):
        return search
    named = not structure and (supported[-1].origin == "library" or not search.found)
    if named and not leaves_more(search):
        return search
    return explain_freely(search, supported if named else (), progress)


def explain_freely(search: EffectSearch, named: Sequence[Step], progress: Progress) -> EffectSearch:
    """The search with terms, where they describe the record better than what it found; else as it was.

    `named`: its steps with effects that are named, empty where none is. Terms are looked for beside them, and on the
    model with what the samples show alone. A model without what the search found takes its place only where it predicts
    left-out blocks better; that of names only where they explain less than half of what it explains, too.
    """
    before, best = _fix_noise(tuple(search.steps)), search
    alone = [step for step in search.steps if step.origin != "library"]
    for base in [named, alone] if len(named) > len(alone) else [alone]:
        if base[-1].searched.noise.band:  # a wave that terms, in white noise, would have to describe
            continue
        chain = _extended(tuple(base), progress)
        own, other = _better(base, chain), _better(before, chain)
        if len(chain) == len(base) or own.gain < thresholds.FREE_FALL:
            continue
        if base is alone and own.errors >= thresholds.BETTER_IF_DOUBTFUL:
            start = _fix_noise(tuple(base))[-1].searched.log_evidence
            names, terms = (each[-1].searched.log_evidence - start for each in (before, chain))
            replaces = other.gain > 0.0
            if named:
                replaces = other.errors >= thresholds.BETTER and names < thresholds.NAMES_SHARE * terms
        else:
            replaces = base is named and own.errors >= thresholds.BETTER_THAN_ALIKE
        if replaces:
            whole = len(base) == len(search.steps)
            best = replace(search, steps=list(chain), refused=search.refused if whole else search.rounds[0])
            before = _fix_noise(chain)
    return best


def _fix_noise(chain: Chain) -> Chain:
    """The chain with its last model in held noise."""
    return (*chain[:-1], replace(chain[-1], searched=fix_noise(chain[-1].searched), known=None))


def _extended(base: Chain, progress: Progress) -> Chain:
    """The base with the terms that left-out blocks ask for; of chains that predict them about equally the shortest.

    At last each term but the newest is left out in turn: a later one may have made it superfluous.
    """
    chains = [base]
    for number in range(MAX_TERMS):
        chains[-1] = _fix_noise(chains[-1])
        last = chains[-1][-1].searched
        fits = fit_terms(last, lambda done, text, number=number: progress((number + done) / MAX_TERMS, text))
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
    for step in near[len(base) : -1]:
        last, term = near[-1], str(step.added)
        without = _without(last, term)
        worse = _better(near, (without,)).errors <= -thresholds.SUPERFLUOUS
        if not worse and not vetoed(last.searched, without.searched):
            near = (*(_without(other, term) for other in near[:-1] if other.added != term), without)
    return (*base, *near[len(base) :])  # the base as it was searched


def _without(step: Step, term: str) -> Step:
    """The step with its model fitted again without a term, if it has it."""
    if term not in dict(step.searched.effects):
        return step
    return replace(step, searched=without_effect(step.searched, term), others=(), known=None)


def _better(before: Sequence[Step], after: Sequence[Step]) -> Difference:
    """Compare the left-out errors of the last models of two chains."""
    return difference(before[-1].left_out, after[-1].left_out)
