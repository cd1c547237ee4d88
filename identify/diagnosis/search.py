"""The search over structures: effects that a record asks for, one after the other.

`search_effects` adds effects of the library to a model as long as the evidence is sufficient. Its result is a list of
steps, each a model with one effect more than the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.candidate_terms import fit_terms, fix_noise
from stimrig.identify.diagnosis.residual import Remainder, ResidualStructure, quiet_rows, residual_structure, vetoed
from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import Effect, Form, find_effect, registry
from stimrig.identify.effects.base import replaced_by
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.effect_fit import (
    BAND_COST,
    Candidate,
    add_effects,
    detected_effects,
    effect_names,
    fit_form,
    fit_from,
    try_effect,
)
from stimrig.identify.estimation.fit_statistics import evaluate
from stimrig.identify.estimation.left_out import Difference, LeftOut, difference, leave_out
from stimrig.identify.estimation.plain import fit_plain, renewed_curve
from stimrig.identify.estimation.samples import Raw
from stimrig.identify.estimation.solve import Fitted, knows_joint, solve, start_from
from stimrig.identify.noise import WHITE_AND_SLOW, NoiseLevel
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record

LEAST_S = 3.0
"""Fitted time, s, below which no effect is looked for: a train of a calibration, 2 s and its rests at most, is of one
width, and its curve and dynamics explain whatever happens in it."""
MAX_EFFECTS = 3
"""Effects at most."""
DYNAMIC = {"speed", "term", "branch", "delay", "filter"}
"""Stages that change how quickly the torque follows."""
FORMS = 3
"""Forms of an effect that are tried beside another effect."""

Progress = Callable[[float, str], None]
"""Called with the share done, 0 to 1, and a line of text. It may raise `Cancelled`."""


def silent(_share: float, _text: str) -> None:
    """A `Progress` that reports nothing."""


@dataclass(frozen=True, eq=False)
class Step:
    """A model of a search: the one before it with one effect more."""

    added: str | None  # None for the base
    searched: Fitted  # the model as the search compares it: all have the same curve's knots and smoothness
    origin: Literal["base", "detected", "library", "free"]  # "detected": seen in the samples before any fit
    tried: tuple[Candidate, ...] = ()  # all effects of the library tried in its round, best first
    renews: bool = False  # whether the curve is chosen again with all rows once effects of the joint are there
    others: tuple[Fitted, ...] = ()  # of a term: the model with another term in its place, likeliest first
    known: LeftOut | None = None  # its errors on left-out blocks, where another process computed them

    @property
    def structure(self) -> list[str]:
        """Its effects with their forms, as MODEL.json lists them."""
        return [f"{name}:{form.name}" for name, form in self.searched.written.effects]

    @property
    def left_out(self) -> LeftOut:
        """Its errors on left-out blocks."""
        return leave_out(self.searched) if self.known is None else self.known

    @property
    def rivals(self) -> list[Fitted]:
        """The models with another term that predict left-out blocks about as well."""
        return [
            fitted
            for fitted in self.others
            if difference(self.left_out, leave_out(fitted)).errors >= -thresholds.BETTER
        ]

    @cached_property
    def fitted(self) -> Fitted:
        """The model as it is used."""
        return renewed_curve(self.searched) if self.renews else self.searched

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """As `evaluate` gives them."""
        return evaluate(self.fitted)


@dataclass
class EffectSearch:
    """Record of a search: the models chosen, and the effects tried."""

    raw: Raw  # what the samples show before any fit
    rows: np.ndarray  # intervals that may be fitted, bool, shape (K,)
    plain: Fitted  # the model without effects
    steps: list[Step]  # the model of the examined structure, then one effect more in each
    quiet: np.ndarray  # intervals in which the muscle rests, bool, shape (K,)
    refused: tuple[Candidate, ...] = ()  # effects of a last round in which none was chosen, best first
    begun_with: tuple[str, ...] = ()  # the structure from which it began: effects, "id" or "id:form"
    number: int = 0  # of the step that is examined, counted from that beginning
    known: Remainder | None = None  # what the last model leaves, once the search has ended
    doubted: tuple[Step, ...] = ()  # the steps that would follow: more probably, nothing is missing

    @property
    def record(self) -> Record:
        """The record."""
        return self.plain.problem.setup.grid.record

    @property
    def base(self) -> Fitted:
        """The model of the examined structure."""
        return self.steps[0].searched

    @property
    def last(self) -> Fitted:
        """The model with all effects found."""
        return self.steps[-1].searched

    @property
    def base_effects(self) -> list[str]:
        """Effects of the structure that is examined."""
        return effect_names(self.base)

    def names(self, *origins: str) -> list[str]:
        """Effects that were added, in order, by their origin."""
        return [str(step.added) for step in self.steps if step.origin in origins]

    @property
    def found(self) -> list[tuple[Step, Step]]:
        """For each effect of the library that was added, the step before it and its own."""
        return [(before, step) for before, step in pairwise(self.steps) if step.origin == "library"]

    @property
    def open(self) -> list[tuple[Step, Step]]:
        """The same for the effects that are doubted."""
        return list(pairwise([self.steps[-1], *self.doubted]))

    @property
    def start(self) -> Step:
        """The step from which the search began: with all that the samples show."""
        return self.steps[len(self.names("detected"))]

    @property
    def rounds(self) -> list[tuple[Candidate, ...]]:
        """Effects tried in each round, best first."""
        return [*(step.tried for _, step in self.found), *([self.refused] if self.refused else [])]

    def margin(self, number: int) -> float:
        """Log evidence that an effect must gain in a round."""
        return thresholds.NEXT_MARGIN if number or {*self.base_effects} - self.in_samples else thresholds.FIRST_MARGIN

    @property
    def in_samples(self) -> set[str]:
        """Effects that the samples show."""
        return {effect for effect, _, _ in detected_effects(self.raw)}

    @property
    def remainder(self) -> Remainder:
        """What the last model leaves: the same from whichever step it is looked at."""
        assert self.known is not None, "the search has ended"
        return self.known

    def from_step(self, number: int) -> EffectSearch:
        """The same search as one that examines the model of a step: what it lacks are the effects added after it."""
        steps = self.steps[number:]
        base = replace(steps[0], added=None, origin="base", tried=(), others=())
        return replace(self, steps=[base, *steps[1:]], number=self.number + number)

    @property
    def residual(self) -> ResidualStructure:
        """What the residual of the last model shows."""
        return residual_structure(self.last, self.quiet)


def search_effects(
    grid: Grid,
    raw: Raw,
    rows: np.ndarray,
    progress: Progress | None = None,
    *,
    structure: Sequence[str] = (),
) -> EffectSearch:
    """Try all effects on a record, add the best, and continue while the evidence is sufficient.

    `grid` and `raw` are as `prepare` makes them, `rows` the pulse intervals to fit. At most `MAX_EFFECTS` effects are
    added. `structure`: effects, "id" or "id:form", that the examined model already has. `progress` may raise
    `Cancelled`.

    Raises NotIdentifiable: less than `LEAST_S` may be fitted, or as `fit_plain`.
    """
    count = int(rows.sum())
    if count * grid.step_s < LEAST_S:
        raise NotIdentifiable(f"only {count} pulse intervals may be fitted", fix="Give at least a few seconds of data.")
    plain = fit_plain(grid, rows)
    base = renewed_curve(add_effects(plain, structure, raw))
    steps = [Step(None, base, "base", renews=not knows_joint(base))]
    for effect, detected_form, values in detected_effects(raw):
        if effect not in effect_names(steps[-1].searched):
            fitted = fit_from(steps[-1].searched, effect, detected_form, values)
            steps.append(replace(steps[0], added=effect, searched=fitted, origin="detected"))
    search = EffectSearch(raw, rows, plain, steps, quiet_rows(steps[-1].searched), begun_with=tuple(structure))
    for number in range(MAX_EFFECTS):
        if not _add_best(search, progress or silent, number):
            break
        _exchange(search)
    return search


def _add_best(search: EffectSearch, progress: Progress, number: int) -> bool:
    """Add the likeliest effect of a round that predicts left-out blocks better; return False if none does.

    Where the likelihood cannot be trusted, the effect that predicts them best of those that are likely enough.
    """
    last, before = search.steps[-1], next(iter(search.rounds), ())  # none also where an exchange left no effect
    present = effect_names(last.searched)
    listed = [effect for effect in registry().values() if _applicable(effect, last.searched, present)]
    # Slow ones first, so that all processes end at about the same time.
    listed.sort(key=lambda effect: -len(effect.forms))
    tried = scan(last.searched, listed, before, lambda done, text: progress(0.1 + 0.3 * (number + done), text))
    candidates = sorted(map(_discounted, tried), key=_by_gain)
    accepted: list[tuple[float, Candidate]] = []
    for place, candidate in enumerate(candidates):
        if candidate.gain < search.margin(number) or (accepted and not last.searched.distrusted):
            break
        comparison = difference(last.left_out, leave_out(candidate.fitted))
        refusal = _refusal(search, candidate, comparison)
        if refusal is None:
            accepted.append((comparison.gain, candidate))
        else:
            candidates[place] = replace(candidate, refusal=refusal)
    if not accepted:
        search.refused = tuple(candidates)
        return False
    best = max(accepted, key=lambda entry: entry[0])[1]
    added = {"added": best.effect.id, "searched": released(best.fitted), "tried": tuple(candidates)}
    search.steps.append(replace(search.steps[0], origin="library", **added))
    return True


def _exchange(search: EffectSearch) -> None:
    """Drop an earlier effect that is no longer needed beside the last one, or replace it if a rival now does better."""
    last, found = search.last, [step for _, step in search.found]
    for number, step in enumerate(found[:-1]):
        without = without_effect(last, str(step.added))
        if without.log_evidence > last.log_evidence - thresholds.TEMPERATURE:
            _rebuild(search, without, [other for other in found if other is not step])
            return
        left = [c for c in step.tried if c.effect.id not in search.names("library") and not c.effect.band]
        for rival in [c for c in left if c.refusal is None or not c.effect.sporadic][:2]:
            refitted = fit_form(rival.effect, rival.form, without, without.residual_nm, {})
            if refitted is not None and refitted.log_evidence > last.log_evidence + thresholds.TEMPERATURE:
                replaced = replace(step, added=rival.effect.id)
                _rebuild(search, refitted, [*found[:number], replaced, *found[number + 1 :]])
                return


def _rebuild(search: EffectSearch, last: Fitted, found: Sequence[Step]) -> None:
    """Set the steps as if the effects of a model had been added in this order, as long as each gains enough."""
    del search.steps[1 + len(search.names("detected")) :]
    forms = dict(last.effects)
    for number, step in enumerate(found):
        before, effect = search.last, find_effect(str(step.added))
        wanted = [name for name, _ in before.effects] + ([] if effect.band else [effect.id])
        if number == len(found) - 1:
            fitted = last
        else:
            problem = Problem(last.problem.setup, [(name, forms[name]) for name in wanted])
            banded = any(find_effect(str(other.added)).band for other in found[: number + 1])
            fitted = solve(problem, start_from(problem, last, {}), last.noise if banded else before.noise)
        gain = fitted.log_evidence - before.log_evidence + prior(effect)
        known = next((c.forms for c in step.tried if c.effect.id == effect.id), {})
        chosen = forms.get(effect.id, effect.forms[0])
        candidate = _discounted(Candidate(effect, chosen, fitted, gain, known | {chosen.name: gain}))
        comparison = difference(search.steps[-1].left_out, leave_out(fitted))
        if candidate.gain < search.margin(number) or not comparison.errors >= required_errors(search, candidate):
            return  # beside the other effects it no longer gains enough
        # The rivals were fitted beside another model: they are taken to gain at most what the added effect gained.
        others = [replace(c, gain=min(c.gain, candidate.gain)) for c in step.tried if c.effect.id != effect.id]
        tried = tuple(sorted([candidate, *others], key=_by_gain))
        search.steps.append(replace(search.steps[0], added=effect.id, searched=fitted, origin="library", tried=tried))


def _refusal(search: EffectSearch, candidate: Candidate, comparison: Difference) -> str | None:
    """Why left-out blocks refuse a candidate, by a `comparison` with the last model, in words; None if they do not.

    An effort that hardly comes at rest is refused, too, where a term predicts them better: the pulses cause it.
    """
    required = required_errors(search, candidate)
    if not comparison.errors >= required:
        needed = "It must not rise."
        if required > 0.0:
            needed = f"It must fall by {required:g} of its standard errors at least."
        elif required < 0.0:
            needed = f"It may rise by {-required:g} of its standard errors at most."
        return f"{comparison.words} {needed}"
    if not only_at_work(search.quiet, candidate.fitted, candidate.effect.id):
        return None
    term = max(fit_terms(fix_noise(search.last), silent), key=lambda fitted: fitted.log_evidence, default=None)
    if term is None or (instead := difference(leave_out(candidate.fitted), leave_out(term))).gain <= 0.0:
        return None
    name = find_effect(term.effects[-1][0]).name.lower()
    return f"It hardly comes at rest, and {name} predicts better: in its place the error {instead.change}."


def required_errors(search: EffectSearch, candidate: Candidate) -> float:
    """Standard errors by which the error on left-out blocks must fall with an effect.

    Of one that cannot be foreseen none, and where its likelihood can be trusted it may even rise by one. More is asked
    of an effect that may only repair the inexact form of one that is there. A narrow band of noise is not judged by
    blocks: it changes no prediction.
    """
    effect = candidate.effect
    if effect.band:
        return -np.inf
    if not effect.predictable:
        return 0.0 if search.last.distrusted else -thresholds.BETTER
    if resembles_earlier(search.last, effect, candidate.form.stage, search.names("detected")):
        return thresholds.BETTER_THAN_ALIKE
    return thresholds.BETTER_IF_DOUBTFUL if candidate.gain < thresholds.NEXT_MARGIN else thresholds.BETTER


def resembles_earlier(before: Fitted, effect: Effect, stage: str, detected: Iterable[str]) -> bool:
    """Return True if an effect may only repair the form of an effect already in the model.

    This is so if the two resemble each other, both change the dynamics, or the present one is free (cause unknown).
    """
    return any(
        find_effect(name).shape
        or name in effect.resembles
        or effect.id in find_effect(name).resembles
        or (stage in DYNAMIC and present_form.stage in DYNAMIC)
        for name, present_form in before.effects
        if name not in detected
    )


def released(fitted: Fitted) -> Fitted:
    """The model with its noise no longer held, where its likelihood can then be trusted."""
    if not fitted.noise.held:
        return fitted
    free = solve(fitted.problem, fitted.theta, WHITE_AND_SLOW)
    return fitted if free.distrusted else free


# ---- one round: every effect of the library tried on a model -----------------------------------------------------


def scan(base: Fitted, listed: list[Effect], before: Sequence[Candidate], progress: Progress) -> list[Candidate]:
    """Add each of some effects to a model; best first. `before` holds the candidates of an earlier round."""
    earlier = {candidate.effect.id: candidate for candidate in before}

    def tried(number: int) -> Candidate | None:
        """Without the problem: it holds functions, which cannot be sent between processes."""
        effect = listed[number]
        candidate = try_effect(effect, base, _likeliest_forms(effect, earlier.get(effect.id)))
        if candidate is None:
            return None
        fitted: Any = replace(candidate.fitted, problem=None)  # type: ignore
        return replace(candidate, effect=None, form=candidate.form.name, fitted=fitted)  # type: ignore

    candidates: list[Candidate] = []
    for done, (number, result) in enumerate(side_by_side(tried, len(listed)), start=1):
        effect = listed[number]
        progress(done / len(listed), f"tried {effect.name.lower()}")
        if result is not None:
            chosen = effect.form(str(result.form))
            problem = Problem(base.problem.setup, [*base.effects, *([] if effect.band else [(effect.id, chosen)])])
            fitted = replace(result.fitted, problem=problem)
            candidates.append(replace(result, effect=effect, form=chosen, fitted=fitted))
    return sorted(candidates, key=_by_gain)


def _by_gain(candidate: Candidate) -> tuple[float, str]:
    """The best first."""
    return -candidate.gain, candidate.effect.id


def _applicable(effect: Effect, base: Fitted, present: Iterable[str]) -> bool:
    """Return True if an effect can be tried: no earlier step covers it, it is not present, the record has its columns.

    Only the likelihood asks for one that comes and goes by no law: not where jumps of held readings decide the
    likelihood, and for a narrow band of noise not where the noise is held white.
    """
    grid = base.problem.setup.grid
    record, jumps = grid.record, base.heavy_tails and grid.readings is not None
    applicable = effect.detect is None and not effect.shape and effect.id not in present
    applicable = applicable and not (effect.sporadic and jumps) and not (effect.band and base.noise.held)
    applicable = applicable and not replaced_by(base.effects, effect.forms)
    return applicable and all(record.knows(need) for need in effect.needs)


def _likeliest_forms(effect: Effect, before: Candidate | None) -> list[Form]:
    """Forms to try beside another effect: those that were best alone; all forms of a chain."""
    if before is None or effect.band or any(known.grows for known in effect.forms):
        return list(effect.forms)
    ranked = sorted(before.forms, key=lambda name: -before.forms[name])
    return [effect.form(name) for name in ranked[:FORMS]]


# ---- what an effect must gain --------------------------------------------------------------------------------------


def share_at_rest(quiet: np.ndarray, fitted: Fitted, effect: str) -> float:
    """Size of an added torque at rest, divided by its size at work. Efforts come at any time, stimulated or not."""
    setup = fitted.problem.setup
    added = dict(fitted.effects)[effect]
    values = {name: np.array([[value]]) for name, value in fitted.parameters_of(effect).items()}
    torque = np.broadcast_to(added.call(None, values, setup.scene), (1, quiet.size))[0]
    rest, work = (
        np.mean(torque[rows] ** 2) if np.any(rows) else 0.0 for rows in (setup.fitted & quiet, setup.fitted & ~quiet)
    )
    return float(np.sqrt(rest / max(work, 1e-30)))


def only_at_work(quiet: np.ndarray, fitted: Fitted, effect: str) -> bool:
    """Return True for efforts that do not appear at rest: the stimulation itself may cause them."""
    added = dict(fitted.effects).get(effect)
    sporadic = added is not None and added.stage == "additive" and find_effect(effect).sporadic
    return sporadic and share_at_rest(quiet, fitted, effect) < thresholds.SHARE_AT_REST


def _discounted(candidate: Candidate) -> Candidate:
    """The candidate with its gain reduced if it is an effort."""
    effort = candidate.effect.sporadic and not candidate.effect.band
    return replace(candidate, gain=thresholds.UNSURE * candidate.gain) if effort else candidate


def prior(effect: Effect) -> float:
    """Term added to a gain of log evidence: the effect's prior odds, less the cost of a narrow band."""
    return effect.prior - (BAND_COST if effect.band else 0.0)


def without_effect(fitted: Fitted, effect: str) -> Fitted:
    """The model refitted without one of its effects."""
    noise = fitted.noise
    others = [(name, effect_form) for name, effect_form in fitted.effects if name != effect]
    if len(others) == len(fitted.effects):
        noise = NoiseLevel(noise.ar1, noise.share, noise.sd_nm)
    problem = Problem(fitted.problem.setup, others)
    return solve(problem, start_from(problem, fitted, {}), noise)


def helpful(search: EffectSearch) -> tuple[list[Step], list[dict[str, Any]]]:
    """The steps up to the first that raises the error on held-out pulses, and the effects refused for that reason.

    Terms are judged together: the first ones may help only beside the later ones.
    """
    steps = search.steps
    chain = next((number for number, step in enumerate(steps) if step.origin == "free"), len(steps))
    for number in range(1, min(chain + 1, len(steps))):
        last = steps[-1] if number == chain else steps[number]
        objection = None if last.origin == "detected" else vetoed(steps[number - 1].fitted, last.fitted)
        if objection is None:
            continue
        first = find_effect(str(steps[number].added)).name
        reason = f"It was found beside another effect, against which held-out pulses speak: {first}."
        against = [{"effect": step.added, "log_evidence_gain": None, "reason": reason} for step in steps[number:]]
        against[0]["reason"] = objection
        return steps[:number], against
    return steps, []
