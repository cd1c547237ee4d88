"""The verdict of a search for effects, with probabilities calibrated on development records (docs/diagnosis.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import HeldOutError, held_out_error, vetoed
from stimrig.identify.diagnosis.search import EffectSearch, resembles_earlier, share_at_rest
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.candidates import likelihood_warnings
from stimrig.identify.estimation.effect_fit import Candidate
from stimrig.identify.estimation.joint import Fitted


@dataclass(frozen=True)
class Verdict:
    """The verdict on a search for effects."""

    kind: str  # "effect_missing", "nothing_missing" or "unexplained_structure"
    probabilities: dict[str, float]  # by effect, of those added
    rivals: dict[str, dict[str, float]]  # for each effect found: probabilities of all effects tried in the same round
    explained: float  # share of the explainable log-likelihood that the effects explain
    structure: float  # log-likelihood by which the residuals at work and at rest still differ
    probability: float  # of the verdict as a whole
    held_out_error: HeldOutError | None = None  # of the last model; None if held-out pulses cannot be judged
    notes: list[str] = field(default_factory=list)  # reasons, for people
    objections: dict[str, str] = field(default_factory=dict)  # by effect: what held-out pulses say against it


def shares(candidates: list[Candidate], max_gain: float = np.inf) -> dict[str, float]:
    """Probability of each candidate, and under the key "" that none of them is there.

    Gains are limited to `max_gain`, that of the effect which was added: where the likelihood decides nothing, a
    likelier candidate is only a rival.
    """
    if not candidates:
        return {"": 1.0}
    top = min(candidates[0].gain, max_gain)
    spread = thresholds.TEMPERATURE + thresholds.RELATIVE * max(top, 0.0)
    weights = {c.effect.id: float(np.exp(max((min(c.gain, max_gain) - top) / spread, -60.0))) for c in candidates}
    # An effect whose gain equals the margin has a probability of one half.
    weights[""] = float(np.exp(np.clip(thresholds.FIRST_MARGIN - top, -60.0, 60.0)))
    total = sum(weights.values())
    return {name: (1.0 - thresholds.UNKNOWN_FORM) * weight / total for name, weight in weights.items()}


def _nothing(candidates: list[Candidate]) -> float:
    """Probability that none of the candidates is there."""
    return 1.0 / (1.0 + sum(float(np.exp(min(c.gain - thresholds.FIRST_MARGIN, 60.0))) for c in candidates))


def _no_effort(search: EffectSearch, explained: float, structure: bool) -> bool:
    """Return True if apparent efforts are more likely caused by the stimulation."""
    if explained < thresholds.LEAST_EXPLAINED_BY_EFFORTS and structure:
        return True
    effort = search.added[0]
    holder = search.chain[1]
    if share_at_rest(search.quiet, holder, effort) >= thresholds.SHARE_AT_REST:
        return False
    return (
        "resisting" in dict(holder.effects)[effort].name
        or _efforts(holder.parameters_of(effort)) >= thresholds.MANY_EFFORTS
    )


def _only_at_work(search: EffectSearch, number: int) -> bool:
    """Return True if a sporadic added torque does not appear at rest."""
    effect, holder = search.added[number], search.chain[number + 1]
    form = dict(holder.effects).get(effect)
    if form is None or form.stage != "additive" or not find_effect(effect).sporadic:
        return False
    return share_at_rest(search.quiet, holder, effect) < thresholds.SHARE_AT_REST


def _everywhere(search: EffectSearch) -> bool:
    """Return True if apparent efforts last for much of the test: true efforts are rare."""
    effort = search.added[0]
    holder = search.chain[1]
    widths = [value for name, value in holder.parameters_of(effort).items() if name.startswith(("width_", "decay_"))]
    setup = holder.problem.setup
    return 2.0 * sum(widths) > thresholds.EFFORTS_LAST * float(setup.fitted.sum()) * setup.grid.step_s


def _efforts(parameters: dict[str, float]) -> int:
    """Number of efforts: bumps close to one another count as one."""
    centres = np.sort([value for name, value in parameters.items() if name.startswith("centre_")])
    return int(np.sum(np.diff(centres) > thresholds.APART_S)) + 1 if centres.size else 0


def _contradicted(before: HeldOutError | None, after: HeldOutError) -> bool:
    """Return True if the error on held-out pulses shows that structure is left."""
    if after.ratio < thresholds.HELD_OUT_RATIO:
        return False
    return before is None or after.excess_nm > thresholds.HELD_OUT_SHARE * before.excess_nm


def _beyond(error: HeldOutError) -> str:
    return (
        f"On held-out pulses the error of the last model is {error.ratio:.1f} times what noise and its uncertainty "
        "allow: something is still missing."
    )


def _explained(search: EffectSearch, first: Fitted) -> float:
    """Share of the explainable log-likelihood that the effects explain."""
    possible = search.residuals[-1].ideal - first.log_likelihood
    return float((search.last.log_likelihood - first.log_likelihood) / max(possible, 1.0))


def judge_free(search: EffectSearch, before: Verdict, named: bool) -> Verdict:
    """The verdict with free effects. They name nothing: what was `named` of the library's effects stays."""
    first, last = search.plain if search.base_effects else search.chain[0], search.last
    errors = [held_out_error(fitted, thresholds.FORM_ERROR_WITH_EFFECTS, last) for fitted in (first, last)]
    readings = search.raw.readings
    notes = [*([] if readings is None else [readings.words]), *likelihood_warnings(last)]
    if errors[1] is not None and _contradicted(errors[0], errors[1]):
        notes.append(_beyond(errors[1]))
    return replace(
        before,
        kind=before.kind if named else "unexplained_structure",
        probabilities={
            effect: p for effect, p in before.probabilities.items() if effect in (*search.detected, *search.added)
        },
        explained=_explained(search, first),
        structure=search.residuals[-1].ratio,
        held_out_error=errors[1],
        notes=notes,
    )


def judge(search: EffectSearch) -> Verdict:
    """The verdict on a search for effects."""
    first, last = search.plain if search.base_effects else search.chain[0], search.last
    effects = [*search.base_effects, *search.added]
    residual = search.residuals[-1]
    explained = _explained(search, first) if effects else 0.0
    readings = search.raw.readings
    notes = [*([] if readings is None else [readings.words]), *likelihood_warnings(last)]
    probabilities: dict[str, float] = dict.fromkeys(search.detected, 0.99)
    rivals: dict[str, dict[str, float]] = {}
    objections: dict[str, str] = {}
    rounds = [[c for c in tried if c.refused is None] for tried in search.rounds]
    for number, effect in enumerate(search.added):
        competitors = [c for c in rounds[number] if c.effect.id == effect or c.effect.id not in search.added]
        rivals[effect] = shares(competitors, next((c.gain for c in competitors if c.effect.id == effect), np.inf))
        # A later effect is at most as probable as those before it.
        probabilities[effect] = min(
            [rivals[effect].get(effect, 0.5), *(probabilities[e] for e in search.added[:number] if e in probabilities)]
        )
        stage = dict(search.chain[number + 1].effects).get(effect, find_effect(effect).forms[0]).stage
        if resembles_earlier(search.chain[number], find_effect(effect), stage, search.detected):
            probabilities[effect] = min(probabilities[effect], thresholds.REPAIR_PROBABILITY)
        if _only_at_work(search, number):
            probabilities[effect] = min(probabilities[effect], thresholds.ONLY_AT_WORK_PROBABILITY)
        if objection := vetoed(search.chain[number], search.chain[number + 1]):
            objections[effect] = objection
            probabilities[effect] = min(probabilities[effect], thresholds.DOUBTED)
            notes.append(f"The error on held-out pulses rises with this effect: {find_effect(effect).name}.")
    structure = residual.ratio
    if last.noise.band > 0.0:
        # The narrow band itself is not structure: what counts is what remains beside it.
        before = max(search.residuals[0].busy_nm ** 2 - residual.white_nm**2, 1e-12)
        explained = 1.0 - max(residual.busy_nm**2 - residual.white_nm**2, 0.0) / before
    strange = readings is not None and readings.held_s > thresholds.LONGEST_HELD_S
    if effects:
        strange = strange or (explained < thresholds.LEAST_EXPLAINED and residual.significant)
        lawless = any(
            search.free_gain > first_round[0].gain + thresholds.FREE_GAIN_MARGIN
            for first_round in search.rounds[:1]
            if first_round
        )
        strange = strange or (lawless and explained < thresholds.EXPLAINED_BY_LAWS)
        if find_effect(effects[0]).band:
            strange = strange or (
                explained < thresholds.LEAST_EXPLAINED_BY_BAND and structure > thresholds.STRUCTURE_BESIDE_BAND
            )
        elif search.added and find_effect(search.added[0]).sporadic:
            strange = strange or _everywhere(search) or _no_effort(search, explained, residual.significant)
    else:
        refused = max((c.gain for tried in search.rounds for c in tried if c.refused), default=0.0)
        strange = strange or residual.significant or (refused > thresholds.REFUSED and not last.heavy_tails)
    # Naming an effect claims more than naming none, so less error is allowed.
    form = thresholds.FORM_ERROR_WITH_EFFECTS if effects else thresholds.FORM_ERROR
    before, after = (held_out_error(fitted, form, last) for fitted in (first, last))
    if after is not None and _contradicted(before, after):
        strange = True
        notes.append(_beyond(after))
    if strange:
        probabilities = {effect: min(p, thresholds.DOUBTED) for effect, p in probabilities.items()}
        kind = "unexplained_structure"
        probability = 0.9
    elif probabilities:
        kind, probability = "effect_missing", max(probabilities.values())
    else:
        kind, probability = "nothing_missing", _nothing(search.rounds[0] if search.rounds else [])
    return Verdict(
        kind,
        probabilities,
        rivals,
        explained=float(explained),
        structure=float(structure),
        probability=float(probability),
        held_out_error=after,
        notes=notes,
        objections=objections,
    )
