"""From a record to a chain of models: the base, then one effect after the other while the evidence lasts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from identify.diagnosis.candidates import Progress, scan
from identify.diagnosis.structure import Left, left_over, quiet_rows
from identify.diagnosis.thresholds import (
    AFTER_LAWS,
    AT_WORK_ONLY,
    BORNE_OUT,
    DYNAMIC,
    FIRST_MARGIN,
    KINDRED,
    NEXT_MARGIN,
    PATCH,
    PATCHER,
    SEEN_APART,
    SEEN_AT_REST,
    SLOWEST,
)
from identify.diagnosis.unknown import WANDER
from identify.effects import get, registry
from identify.effects.base import Effect
from identify.estimation.adding import (
    BAND_COST,
    Candidate,
    added,
    fit_form,
    given_by_samples,
    names,
    try_effect,
    with_effects,
)
from identify.estimation.joint import Fitted, solve, start_from
from identify.estimation.prepare import Raw, plain, prepare
from identify.estimation.rows import fitted_rows
from identify.noise.level import NoiseLevel
from identify.records.record import Record
from identify.simulation.problem import Problem

MOST = 3
"""Effects at most."""


@dataclass
class Analysis:
    """What was tried on a record, and what came of it.

    Parameters
    ----------
    record : Record
        As given.
    raw : Raw
        What was seen before averaging.
    plain : Fitted
        The model without effects.
    base : Fitted
        The structure that is criticised.
    given : list of str
        Effects seen in the raw samples.
    with_given : list of Fitted
        The base with the first of them, with the first two, ….
    rounds : list of list of Candidate
        Candidates of each round, best first; round i starts from chain[i].
    chain : list of Fitted
        The base (with what was given), then with one effect more each time.
    added : list of str
        Effects added, in order.
    margins : list of float
        Log evidence asked for in each round.
    nameless : list of float
        Log evidence for a gain that wanders without a law, in each round.
    losses : dict
        Log evidence lost without each effect, where there are several.
    quiet : ndarray of bool
        Intervals in which the muscle rests.
    left : list of Left
        What is left after each model of the chain.
    """

    record: Record
    raw: Raw
    plain: Fitted
    base: Fitted
    given: list[str] = field(default_factory=list)
    with_given: list[Fitted] = field(default_factory=list)
    rounds: list[list[Candidate]] = field(default_factory=list)
    chain: list[Fitted] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)
    nameless: list[float] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    quiet: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    left: list[Left] = field(default_factory=list)

    @property
    def held(self) -> list[str]:
        """Effects of the structure that is criticised."""
        return names(self.base)

    @property
    def last(self) -> Fitted:
        """The model with all that was found."""
        return self.chain[-1]


def analyse(
    record: Record,
    progress: Progress | None = None,
    *,
    most: int = MOST,
    effects: Iterable[Effect] | None = None,
    fitted: np.ndarray | None = None,
    structure: Sequence[str] = (),
) -> Analysis:
    """Try all effects on a record, add the best, and go on while the evidence lasts.

    `structure` names effects, "id" or "id:form", that the model criticised holds already.
    """
    listed = list(registry().values() if effects is None else effects)
    grid, raw = prepare(record)
    bare = plain(grid, fitted_rows(grid, None) if fitted is None else fitted)
    base = with_effects(bare, structure, raw)
    work = Analysis(record, raw, bare, base)
    start = _with_given(work, base)
    work.chain, work.quiet = [start], quiet_rows(start)
    work.left = [left_over(start, work.quiet, raw.noise_sd_nm)]
    for number in range(most):
        if number and _exhausted(work):
            break
        before = work.rounds[0] if work.rounds else None
        candidates = scan(work.last, listed, progress, (0.1 + 0.3 * number, 0.4 + 0.3 * number), before)
        candidates = sorted((_tempered(work, c) for c in candidates), key=lambda c: -c.gain)
        work.rounds.append(candidates)
        nameless = try_effect(WANDER, work.last)
        work.nameless.append(nameless.gain if nameless else 0.0)
        work.margins.append(_margin(work, len(work.added)))
        enough = [c for c in candidates if c.gain >= _margin(work, len(work.added), c)]
        if not enough:
            break
        _take(work, enough[0].fitted, enough[0].effect.id)
        if number:
            _exchange(work)
    if len(work.added) > 1:
        for effect in work.added:
            without = _without(work.last, effect)
            work.losses[effect] = work.last.log_evidence - (without.log_evidence if without else 0.0)
    return work


def seen_at_rest(quiet: np.ndarray, fitted: Fitted, effect: str) -> float:
    """An added torque, in rests over in work: efforts come when they like, not when the stimulator works."""
    setup = fitted.problem.setup
    form = next(form for name, form in fitted.effects if name == effect)
    values = {name: np.array([[value]]) for name, value in fitted.parameters_of(effect).items()}
    torque = np.broadcast_to(form.call(None, values, setup.scene), (1, quiet.size))[0]
    parts = [
        np.mean(torque[rows] ** 2) if np.any(rows) else 0.0 for rows in (setup.fitted & quiet, setup.fitted & ~quiet)
    ]
    return float(np.sqrt(parts[0] / max(parts[1], 1e-30)))


def _tempered(work: Analysis, candidate: Candidate) -> Candidate:
    """An effort counts for a little less than a law that explains as much, and for less yet if only work shows it."""
    if candidate.effect.foreseeable or candidate.effect.band:
        return candidate
    seen = candidate.form.stage != "additive" or _at_rest(work, candidate)
    return replace(candidate, gain=(AFTER_LAWS if seen else AT_WORK_ONLY) * candidate.gain)


def _at_rest(work: Analysis, candidate: Candidate) -> bool:
    return seen_at_rest(work.quiet, candidate.fitted, candidate.effect.id) >= SEEN_AT_REST


def _margin(work: Analysis, number: int, candidate: Candidate | None = None) -> float:
    """Log evidence that an effect must gain in a round: a patch on the first one's imperfect form isn't an effect."""
    if not number and not work.held:
        return FIRST_MARGIN
    return max(NEXT_MARGIN, (PATCH if candidate is None else _patch(work, candidate)) * _first_gain(work))


def _first_gain(work: Analysis) -> float:
    """What the first effect gained, or those that were held; a narrow band is noise, with no form to be patched."""
    if work.held:
        return 0.0 if any(get(name).band for name in work.held) else work.base.log_evidence - work.plain.log_evidence
    return 0.0 if work.rounds[0][0].effect.band else work.rounds[0][0].gain


def _patch(work: Analysis, candidate: Candidate) -> float:
    effect, stage = candidate.effect, candidate.form.stage
    if not effect.foreseeable:
        return PATCHER
    if stage == "additive":
        return 0.5 * SEEN_APART
    if stage in ("gain", "pulse_width") and work.nameless[-1] > BORNE_OUT * candidate.gain:
        return SEEN_APART
    for name, form in work.last.effects:
        if name in work.given:
            continue
        if form.stage in DYNAMIC and stage in DYNAMIC:
            return KINDRED
        if name in effect.resembles or effect.id in get(name).resembles:
            return KINDRED
    return PATCH


def _take(work: Analysis, fitted: Fitted, effect: str) -> None:
    work.added.append(effect)
    work.chain.append(fitted)
    work.left.append(left_over(fitted, work.quiet, work.raw.noise_sd_nm))


def _exhausted(work: Analysis) -> bool:
    """Whether no further effect could gain what is asked: the residual is nearly as small and white as noise can be."""
    left, last = work.left[-1], work.last
    if last.noise.ar1 > SLOWEST and left.slow_nm > left.white_nm:
        return False  # noise so slow may be a drift: the rests can't say what is ideal
    least = max(NEXT_MARGIN, SEEN_APART * _first_gain(work))
    return left.ideal - last.log_likelihood < least and left.ratio < least


def _with_given(work: Analysis, base: Fitted) -> Fitted:
    """The base model with what the raw samples show beyond doubt."""
    for effect, form, values in given_by_samples(work.raw):
        if effect in names(base):
            continue
        base = added(base, effect, form, values)
        work.given.append(effect)
        work.with_given.append(base)
    return base


def _exchange(work: Analysis) -> None:
    """After a further effect: would a rival of an earlier one now do better, or can an earlier one go?"""
    last = work.last
    for index, effect in enumerate(list(work.added[:-1])):
        rivals = [c for c in work.rounds[index] if c.effect.id not in work.added][:2]
        without = _without(last, effect)
        if without is not None and without.log_evidence > work.last.log_evidence - 1.0:
            work.added.remove(effect)
            _rebuild(work, without)
            return
        if without is None:
            continue
        for rival in rivals:
            if rival.gain < 0.5 * work.rounds[index][0].gain:
                continue
            if rival.effect.band:
                continue
            found = fit_form(rival.effect, rival.form, without, without.residual_nm, {})
            if found is not None and found.log_evidence > work.last.log_evidence + 2.0:
                won = found.log_evidence - work.last.log_evidence
                work.added[index] = rival.effect.id
                _rebuild(work, found, index, won)
                return


def _rebuild(work: Analysis, last: Fitted, index: int = -1, won: float = 0.0) -> None:
    """Chain, rounds and margins as they would be, had the effects of the last model been added one after the other.

    In the round `index` an effect beat, by `won`, one that had gained more alone.
    """
    wanted, tried = work.added, work.rounds[: len(work.added)]
    work.added, work.chain, work.left = [], work.chain[:1], work.left[:1]
    work.rounds, work.margins, work.nameless = [], [], work.nameless[: len(wanted)]
    for number, effect in enumerate(wanted):
        before = work.last
        fitted = last if number == len(wanted) - 1 else _part(last, before, [*names(before), effect])
        known = next((c for c in tried[number] if c.effect.id == effect), None)
        described = get(effect)
        gain = fitted.log_evidence - before.log_evidence + described.prior - (BAND_COST if described.band else 0.0)
        form = dict(fitted.effects).get(effect, described.forms[0])
        found = Candidate(described, form, fitted, gain, (known.forms if known else {}) | {form.name: gain})
        found = _tempered(work, found)
        if fitted is last and found.gain < _margin(work, number, found):
            return  # beside the others as they are now it is not worth its place
        # Rivals of the other rounds were measured beside another model: they gain what was added at most.
        most = found.gain - (won if number == index else 0.0)
        rivals = [replace(c, gain=min(c.gain, most)) for c in tried[number] if c.effect.id != effect]
        work.rounds.append(sorted([found, *rivals], key=lambda c: -c.gain))
        work.margins.append(_margin(work, number))
        _take(work, fitted, effect)


def _part(last: Fitted, before: Fitted, kept: list[str]) -> Fitted:
    """The last model with only some of its effects, from where they stand in it."""
    problem = Problem(last.problem.setup, [(effect, form) for effect, form in last.effects if effect in kept])
    noise = last.noise if any(get(name).band for name in kept) else before.noise
    return solve(problem, start_from(problem, last, {}), noise)


def _without(fitted: Fitted, effect: str) -> Fitted | None:
    """The model refitted without one of its effects."""
    noise = fitted.noise
    others = [(e, f) for e, f in fitted.effects if e != effect]
    if len(others) == len(fitted.effects):
        noise = NoiseLevel(noise.ar1, noise.share, noise.sd_nm)
    problem = Problem(fitted.problem.setup, others)
    return solve(problem, start_from(problem, fitted, {}), noise)
