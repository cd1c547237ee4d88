"""The search over structures: effects that a record asks for, one after the other.

`search_effects` adds effects of the library to a model as long as the evidence is sufficient; `steps` are its models.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import ResidualStructure, quiet_rows, residual_structure, vetoed
from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.diagnosis.thresholds import FIRST_MARGIN
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import Effect, Form, Parameter, Scene, find_effect, form, registry
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
from stimrig.identify.estimation.joint import Fitted, knows_joint, solve, start_from
from stimrig.identify.estimation.left_out import LeftOut, difference, leave_out
from stimrig.identify.estimation.plain import fit_plain, renewed_curve
from stimrig.identify.estimation.samples import Raw
from stimrig.identify.noise import NoiseLevel
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.problem import Problem

MAX_EFFECTS = 3
"""Effects at most."""
FORMS = 3
"""Forms of an effect that are tried beside another effect."""

Progress = Callable[[float, str], None]
"""Called with the share done, 0 to 1, and a line of text. It may raise `Cancelled`."""


def silent(_share: float, _text: str) -> None:
    """A `Progress` that reports nothing."""


@dataclass
class EffectSearch:
    """Record of a search: candidates tried and models chosen. Round i starts from chain[i]."""

    record: Record
    raw: Raw  # what the samples show before any fit
    rows: np.ndarray  # intervals that may be fitted, bool, shape (K,)
    plain: Fitted  # the model without effects
    base: Fitted  # the model of the structure that is examined
    detected: list[str] = field(default_factory=list)  # effects that the samples show before any fit
    with_detected: list[Fitted] = field(default_factory=list)  # the base with the first of them, with the first two, …
    rounds: list[list[Candidate]] = field(default_factory=list)  # candidates of each, best first
    chain: list[Fitted] = field(default_factory=list)  # the base and what was detected, then one effect more each time
    added: list[str] = field(default_factory=list)  # effects, in order
    margins: list[float] = field(default_factory=list)  # log evidence required in each round
    left_out: list[LeftOut] = field(default_factory=list)  # what each model of the chain predicts on left-out blocks
    free_gain: float = 0.0  # log evidence for a gain that varies without a law, beside the first model
    losses: dict[str, float] = field(default_factory=dict)  # log evidence lost without each effect, if of several
    quiet: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))  # intervals in which the muscle rests
    residuals: list[ResidualStructure] = field(default_factory=list)  # what that of each model of the chain shows
    free: list[str] = field(default_factory=list)  # of `added` the last ones, which describe what no other explains

    @property
    def base_effects(self) -> list[str]:
        """Effects of the structure that is examined."""
        return effect_names(self.base)

    @property
    def last(self) -> Fitted:
        """The model with all effects found."""
        return self.chain[-1]

    def append(self, fitted: Fitted, effect: str = "", unseen: LeftOut | None = None) -> None:
        """One model more, with an effect more than the last."""
        self.added += [effect] if effect else []
        self.chain.append(fitted)
        self.left_out.append(unseen or leave_out(fitted))
        self.residuals.append(residual_structure(fitted, self.quiet))


def search_effects(
    grid: Grid,
    raw: Raw,
    rows: np.ndarray,
    progress: Progress | None = None,
    *,
    max_effects: int = MAX_EFFECTS,
    structure: Sequence[str] = (),
) -> EffectSearch:
    """Try all effects on a record, add the best, and continue while the evidence is sufficient.

    `grid` and `raw` are as `prepare` makes them, `rows` the pulse intervals to fit. At most `max_effects` effects are
    added. `structure`: effects, "id" or "id:form", that the examined model already has. `progress` may raise
    `Cancelled`.

    Raises NotIdentifiable: less than `thresholds.LEAST_S` may be fitted, or as `fit_plain`.
    """
    count = int(rows.sum())
    if count * grid.step_s < thresholds.LEAST_S:
        raise NotIdentifiable(f"only {count} pulse intervals may be fitted", fix="Give at least a few seconds of data.")
    plain = fit_plain(grid, rows)
    search = EffectSearch(grid.record, raw, rows, plain, renewed_curve(add_effects(plain, structure, raw)))
    start = _add_detected(search)
    search.quiet = quiet_rows(start)
    search.append(start)
    for number in range(max_effects):
        if number and _exhausted(search):
            break
        best = _best_of_round(search, progress or silent, number)
        if best is None:
            break
        search.append(best[0].fitted, best[0].effect.id, best[1])
        if number:
            _exchange(search)
    if len(search.added) > 1:
        for effect in search.added:
            search.losses[effect] = search.last.log_evidence - without_effect(search.last, effect).log_evidence
    return search


def _add_detected(search: EffectSearch) -> Fitted:
    """The base model with the effects that the samples show beyond doubt."""
    base = search.base
    for effect, detected_form, values in detected_effects(search.raw):
        if effect not in effect_names(base):
            base = fit_from(base, effect, detected_form, values)
            search.detected.append(effect)
            search.with_detected.append(base)
    return base


def _best_of_round(search: EffectSearch, progress: Progress, number: int) -> tuple[Candidate, LeftOut] | None:
    """The likeliest candidate of a round that predicts left-out blocks better; None if none does."""
    before = search.rounds[0] if search.rounds else []
    present = effect_names(search.last)
    listed = [effect for effect in registry().values() if _applicable(effect, search.last, present)]
    # Slow ones first, so that all processes end at about the same time.
    listed.sort(key=lambda effect: -len(effect.forms))
    tried = scan(search.last, listed, before, lambda done, text: progress(0.1 + 0.3 * (number + done), text))
    candidates = sorted((_discounted(search, c) for c in tried), key=_by_gain)
    search.rounds.append(candidates)
    if not number and (lawless := try_effect(FREE_GAIN, search.last)) is not None:
        search.free_gain = lawless.gain
    search.margins.append(_margin(search, len(search.added)))
    accepted = []
    for place, candidate in enumerate(candidates[: thresholds.JUDGED]):
        if candidate.gain < search.margins[-1]:
            break
        unseen = leave_out(candidate.fitted)
        comparison, required = difference(search.left_out[-1], unseen), required_errors(search, candidate)
        if not comparison.errors >= required:
            candidates[place] = replace(candidate, refused=comparison, required=required)
            continue
        accepted.append((comparison.gain, candidate, unseen))
        if not search.last.distrusted:
            break
    if not accepted:
        return None
    _, candidate, unseen = max(accepted, key=lambda entry: entry[0])
    free = released(candidate.fitted)
    return (candidate, unseen) if free is candidate.fitted else (replace(candidate, fitted=free), leave_out(free))


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
        return 0.0 if search.last.distrusted else thresholds.NO_WORSE
    if resembles_earlier(search.last, effect, candidate.form.stage, search.detected):
        return thresholds.BETTER_THAN_ALIKE
    return thresholds.BETTER_IF_WEAK if candidate.gain < thresholds.NEXT_MARGIN else thresholds.BETTER


def resembles_earlier(before: Fitted, effect: Effect, stage: str, detected: Iterable[str]) -> bool:
    """Return True if an effect may only repair the form of an effect already in the model.

    This is so if the two resemble each other, both change the dynamics, or the present one is free (cause unknown).
    """
    return any(
        find_effect(name).shape
        or name in effect.resembles
        or effect.id in find_effect(name).resembles
        or (stage in thresholds.DYNAMIC and present_form.stage in thresholds.DYNAMIC)
        for name, present_form in before.effects
        if name not in detected
    )


def released(fitted: Fitted) -> Fitted:
    """The model with its noise no longer held white, where its likelihood can then be trusted."""
    if not fitted.noise.white_only:
        return fitted
    free = solve(fitted.problem, fitted.theta, NoiseLevel(0.5, 0.5, fitted.noise.sd_nm))
    return fitted if free.distrusted else free


# ---- one round: every effect of the library tried on a model -----------------------------------------------------


def scan(base: Fitted, listed: list[Effect], before: list[Candidate], progress: Progress) -> list[Candidate]:
    """Add each of some effects to a model; best first. `before` holds the candidates of an earlier round."""
    earlier = {candidate.effect.id: candidate for candidate in before}

    def tried(number: int) -> tuple[str, Fitted, float, dict[str, float]] | None:
        """Without the problem: it holds functions, which cannot be sent between processes."""
        effect = listed[number]
        candidate = try_effect(effect, base, _likeliest_forms(effect, earlier.get(effect.id)))
        if candidate is None:
            return None
        return candidate.form.name, replace(candidate.fitted, problem=None), candidate.gain, candidate.forms  # type: ignore

    candidates: list[Candidate] = []
    for done, (number, result) in enumerate(side_by_side(tried, len(listed)), start=1):
        effect = listed[number]
        progress(done / len(listed), f"tried {effect.name.lower()}")
        if result is not None:
            name, fitted, gain, forms = result
            added = [] if effect.band else [(effect.id, effect.form(name))]
            problem = Problem(base.problem.setup, [*base.effects, *added])
            candidates.append(Candidate(effect, effect.form(name), replace(fitted, problem=problem), gain, forms))
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
    applicable = applicable and not (effect.sporadic and jumps) and not (effect.band and base.noise.white_only)
    applicable = applicable and not replaced_by(base.effects, effect.forms)
    return applicable and all(record.knows(need) for need in effect.needs)


def _likeliest_forms(effect: Effect, before: Candidate | None) -> list[Form]:
    """Forms to try beside another effect: those that were best alone; all forms of a chain."""
    if before is None or effect.band or any(known.grows for known in effect.forms):
        return list(effect.forms)
    ranked = sorted(before.forms, key=lambda name: -before.forms[name])
    return [effect.form(name) for name in ranked[:FORMS]]


KNOTS = 36


@form(
    "gain",
    "w = g(t) f(u), log g linear between knots",
    *(Parameter(f"log_gain_{i}", "1", -0.45, 0.45, 0.0, (0.0,), about="log gain at a knot") for i in range(KNOTS)),
)
def free(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """A gain without a law."""
    place = np.clip(scene.time_s / max(scene.span_s, 1e-9), 0.0, 1.0) * (KNOTS - 1)
    first = np.minimum(place.astype(np.int64), KNOTS - 2)
    part = place - first
    values = np.concatenate([p[f"log_gain_{i}"] for i in range(KNOTS)], axis=1)
    return drive * np.exp(values[:, first] * (1.0 - part) + values[:, first + 1] * part)


FREE_GAIN = Effect("free_gain", "Gain that varies without a law", (free,), "", (), "", "")


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


def _discounted(search: EffectSearch, candidate: Candidate) -> Candidate:
    """The candidate with its gain reduced if it is an effort, and reduced more if it is only seen at work."""
    effect = candidate.effect
    if effect.band or not effect.sporadic:
        return candidate
    at_rest = candidate.form.stage != "additive" or (
        share_at_rest(search.quiet, candidate.fitted, effect.id) >= thresholds.SHARE_AT_REST
    )
    weight = thresholds.EFFORT_WEIGHT if at_rest else thresholds.EFFORT_WEIGHT_ONLY_AT_WORK
    return replace(candidate, gain=weight * candidate.gain)


def _margin(search: EffectSearch, number: int) -> float:
    """Log evidence that an effect must gain in a round."""
    return thresholds.NEXT_MARGIN if number or search.base_effects else FIRST_MARGIN


def _exhausted(search: EffectSearch) -> bool:
    """Return True if no further effect can gain enough: the residual is nearly as small and white as noise can be."""
    structure, last = search.residuals[-1], search.last
    if last.noise.ar1 > thresholds.SLOWEST_AR1 and structure.slow_nm > structure.white_nm:
        return False  # such slow noise may be a drift: the rests do not show how small the residual could be
    near = thresholds.NEAR_IDEAL if last.noise.is_white else thresholds.NEXT_MARGIN
    return structure.ideal - last.log_likelihood < near and structure.ratio < thresholds.NEXT_MARGIN


def prior(effect: Effect) -> float:
    """Term added to a gain of log evidence: the effect's prior odds, less the cost of a narrow band."""
    return effect.prior - (BAND_COST if effect.band else 0.0)


# ---- effects replaced and left out ---------------------------------------------------------------------------------


def _exchange(search: EffectSearch) -> None:
    """After a further effect: replace an earlier one if its rival now does better, or drop it if it is not needed."""
    last = search.last
    for index, effect in enumerate(list(search.added[:-1])):
        rivals = [c for c in search.rounds[index] if c.effect.id not in search.added][:2]
        without = without_effect(last, effect)
        if without.log_evidence > last.log_evidence - 1.0:
            search.added.remove(effect)
            _rebuild(search, without)
            return
        for rival in rivals:
            if rival.gain < 0.5 * search.rounds[index][0].gain or rival.effect.band:
                continue
            refitted = fit_form(rival.effect, rival.form, without, without.residual_nm, {})
            if refitted is not None and refitted.log_evidence > last.log_evidence + 2.0:
                search.added[index] = rival.effect.id
                _rebuild(search, refitted, index, refitted.log_evidence - last.log_evidence)
                return


def _rebuild(search: EffectSearch, last: Fitted, index: int = -1, won: float = 0.0) -> None:
    """Set chain, rounds and margins as if the effects of the last model had been added one after the other.

    In round `index` an effect replaced one that had gained more alone; it is better by `won`, in log evidence.
    """
    wanted, tried = search.added, search.rounds[: len(search.added)]
    search.added, search.chain, search.residuals = [], search.chain[:1], search.residuals[:1]
    search.rounds, search.margins, search.left_out = [], [], search.left_out[:1]
    for number, effect in enumerate(wanted):
        before, described = search.last, find_effect(effect)
        fitted = last if number == len(wanted) - 1 else _part(last, before, [*effect_names(before), effect])
        known = next((c.forms for c in tried[number] if c.effect.id == effect), {})
        gain = fitted.log_evidence - before.log_evidence + described.prior - (BAND_COST if described.band else 0.0)
        added_form = dict(fitted.effects).get(effect, described.forms[0])
        candidate = _discounted(search, Candidate(described, added_form, fitted, gain, known | {added_form.name: gain}))
        unseen = leave_out(fitted)
        comparison = difference(search.left_out[-1], unseen)
        if candidate.gain < _margin(search, number) or not comparison.errors >= required_errors(search, candidate):
            return  # beside the other effects it no longer gains enough
        # The rivals were fitted beside another model: they are taken to gain at most what the added effect gained.
        highest_gain = candidate.gain - (won if number == index else 0.0)
        rivals = [replace(c, gain=min(c.gain, highest_gain)) for c in tried[number] if c.effect.id != effect]
        search.rounds.append(sorted([candidate, *rivals], key=_by_gain))
        search.margins.append(_margin(search, number))
        search.append(fitted, effect, unseen)


def _part(last: Fitted, before: Fitted, retained: list[str]) -> Fitted:
    """The last model with only some of its effects, fitted from their present values."""
    problem = Problem(
        last.problem.setup, [(effect, effect_form) for effect, effect_form in last.effects if effect in retained]
    )
    noise = last.noise if any(find_effect(name).band for name in retained) else before.noise
    return solve(problem, start_from(problem, last, {}), noise)


def without_effect(fitted: Fitted, effect: str) -> Fitted:
    """The model refitted without one of its effects."""
    noise = fitted.noise
    others = [(name, effect_form) for name, effect_form in fitted.effects if name != effect]
    if len(others) == len(fitted.effects):
        noise = NoiseLevel(noise.ar1, noise.share, noise.sd_nm)
    problem = Problem(fitted.problem.setup, others)
    return solve(problem, start_from(problem, fitted, {}), noise)


# ---- the models of a search ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """One of the models of a search, each with one effect more than the one before."""

    added: str | None  # None for the base
    fitted: Fitted
    statistics: dict[str, Any]  # see `evaluate`


def steps(search: EffectSearch) -> list[Step]:
    """The base, then the detected effects, then the effects found, in this order.

    The search compares models with one and the same curve. Once it is over, those in which it found what the joint
    does choose their curve with all rows; a base that knew of the joint has done so before.
    """
    models = [search.base, *search.with_detected, *search.chain[1:]]
    if not knows_joint(search.base):
        models = list(map(renewed_curve, models))
    return [
        Step(name, fitted, evaluate(fitted))
        for name, fitted in zip([None, *search.detected, *search.added], models, strict=True)
    ]


def helpful(search: EffectSearch) -> tuple[list[Step], list[dict[str, Any]]]:
    """The steps up to the first that raises the error on held-out pulses, and the effects refused for that reason."""
    row = steps(search)
    for number in range(1 + len(search.detected), len(row)):
        objection = vetoed(row[number - 1].fitted, row[number].fitted)
        if objection is None:
            continue
        first = find_effect(str(row[number].added)).name
        reason = f"It was found beside another effect, against which held-out pulses speak: {first}."
        against = [{"effect": step.added, "log_evidence_gain": None, "reason": reason} for step in row[number:]]
        against[0]["reason"] = objection
        return row[:number], against
    return row, []
