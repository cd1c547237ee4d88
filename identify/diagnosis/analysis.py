"""From a record to a chain of models: the base, then one effect after the other while the evidence lasts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from identify.diagnosis.candidates import Candidate, Progress, fit_form, scan, try_effect
from identify.diagnosis.structure import Left, left_over, quiet_rows
from identify.diagnosis.unknown import WANDER
from identify.effects import registry
from identify.effects.base import Effect, Form
from identify.engine.fit import Fitted, solve, start_from
from identify.engine.noise_level import NoiseLevel
from identify.engine.prepare import Raw, inspect, prepare
from identify.engine.problem import Problem
from identify.record import Record

FIRST_MARGIN = 4.5
"""Log evidence that the first effect must gain."""
NEXT_MARGIN = 10.0
"""Log evidence that a further effect must gain."""
PATCH = 0.12
"""And in proportion to what the first gained."""
PATCHERS = {"voluntary_effort": 0.4}
"""Of those that mend anything, more is asked for."""
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
    base : Fitted
        The model without effects.
    given : list of str
        Effects seen in the raw samples.
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
    base: Fitted
    given: list[str] = field(default_factory=list)
    rounds: list[list[Candidate]] = field(default_factory=list)
    chain: list[Fitted] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)
    nameless: list[float] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    quiet: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    left: list[Left] = field(default_factory=list)

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
) -> Analysis:
    """Try all effects on a record, add the best, and go on while the evidence lasts."""
    listed = list(registry().values() if effects is None else effects)
    raw = inspect(record)
    base = prepare(record, raw, fitted)[1]
    work = Analysis(record, raw, base)
    start = _with_given(work, base)
    work.chain, work.quiet = [start], quiet_rows(start)
    work.left = [left_over(start, work.quiet, raw.noise_sd_nm)]
    for number in range(most):
        if number and _exhausted(work):
            break
        before = work.rounds[0] if work.rounds else None
        candidates = scan(work.last, listed, progress, (0.1 + 0.3 * number, 0.4 + 0.3 * number), before)
        work.rounds.append(candidates)
        nameless = try_effect(WANDER, work.last)
        work.nameless.append(nameless.gain if nameless else 0.0)
        margin = _margin(work)
        work.margins.append(margin)
        enough = [c for c in candidates if c.gain >= max(margin, _least(work, c.effect.id))]
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


def _least(work: Analysis, effect: str) -> float:
    """What a later effect must gain, if it is of the kind that mends anything."""
    return PATCHERS.get(effect, 0.0) * work.rounds[0][0].gain if work.added else 0.0


def _margin(work: Analysis) -> float:
    """Log evidence that the next effect must gain: a patch on the first one's imperfect form isn't an effect."""
    if not work.added:
        return FIRST_MARGIN
    return max(NEXT_MARGIN, PATCH * work.rounds[0][0].gain)


def _take(work: Analysis, fitted: Fitted, effect: str) -> None:
    work.added.append(effect)
    work.chain.append(fitted)
    work.left.append(left_over(fitted, work.quiet, work.raw.noise_sd_nm))


def _exhausted(work: Analysis) -> bool:
    """Whether no further effect could gain what is asked: the residual is nearly as small and white as noise can be."""
    left, last = work.left[-1], work.last
    return left.ideal - last.log_likelihood < _margin(work) and left.ratio < _margin(work)


def _with_given(work: Analysis, base: Fitted) -> Fitted:
    """The base model with what the raw samples show beyond doubt."""
    for effect, form, values in given_by_samples(work.raw):
        effects = [*base.effects, (effect, form)]
        problem = Problem(base.problem.setup, effects)
        base = solve(problem, start_from(problem, base, {len(effects) - 1: values}), base.noise)
        work.given.append(effect)
    return base


def given_by_samples(raw: Raw) -> list[tuple[str, Form, dict[str, float]]]:
    """Effects that the samples show before any fit: a line of the mains, a ceiling; with their parameters."""
    effects, found = registry(), []
    if raw.hum is not None and "mains_hum" in effects:
        found.append(("mains_hum", effects["mains_hum"].forms[0], raw.hum))
    if "sensor_clipping" in effects:
        levels = {"ceiling": raw.ceiling_nm, "floor": raw.floor_nm}
        seen = {name: value for name, value in levels.items() if value is not None}
        if seen:
            form = effects["sensor_clipping"].form("both" if len(seen) == 2 else next(iter(seen)))
            found.append(("sensor_clipping", form, {f"{name}_nm": value for name, value in seen.items()}))
    return found


def _exchange(work: Analysis) -> None:
    """After a further effect: would a rival of an earlier one now do better, or can an earlier one go?"""
    last = work.last
    for index, effect in enumerate(list(work.added[:-1])):
        rivals = [c for c in work.rounds[index] if c.effect.id not in work.added][:2]
        without = _without(last, effect)
        if without is not None and without.log_evidence > work.last.log_evidence - 1.0:
            work.added.remove(effect)
            work.chain[-1] = without
            work.left[-1] = left_over(without, work.quiet, work.raw.noise_sd_nm)
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
                work.added[index] = rival.effect.id
                work.chain[-1] = found
                work.left[-1] = left_over(found, work.quiet, work.raw.noise_sd_nm)
                return


def _without(fitted: Fitted, effect: str) -> Fitted | None:
    """The model refitted without one of its effects."""
    noise = fitted.noise
    others = [(e, f) for e, f in fitted.effects if e != effect]
    if len(others) == len(fitted.effects):
        noise = NoiseLevel(noise.ar1, noise.share, noise.sd_nm)
    problem = Problem(fitted.problem.setup, others)
    return solve(problem, start_from(problem, fitted, {}), noise)
