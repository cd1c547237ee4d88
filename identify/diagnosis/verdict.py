"""The verdict of a search for effects, with probabilities calibrated on development records (docs/diagnosis.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import HeldOutError, held_out_error, residual_structure, vetoed
from stimrig.identify.diagnosis.search import EffectSearch, Step, only_at_work, resembles_earlier
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.candidates import likelihood_warnings
from stimrig.identify.estimation.effect_fit import Candidate
from stimrig.identify.estimation.solve import Fitted

LONGEST_HELD_S = 0.05
"""A reading that is held for longer than two pulses hides how the torque rises and falls."""


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
    objections: dict[str, str] = field(default_factory=dict)  # by effect: what speaks against it


def shares(candidates: Sequence[Candidate], max_gain: float = np.inf) -> dict[str, float]:
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


def _nothing(candidates: Sequence[Candidate]) -> float:
    """Probability that none of the candidates is there."""
    return 1.0 / (1.0 + sum(float(np.exp(min(c.gain - thresholds.FIRST_MARGIN, 60.0))) for c in candidates))


def _no_effort(search: EffectSearch) -> bool:
    """Return True if apparent efforts are more likely caused by the stimulation."""
    step = search.found[0][1]
    effort, holder = str(step.added), step.searched
    return only_at_work(search.quiet, holder, effort) and "resisting" in dict(holder.effects)[effort].name


def _swings(fitted: Fitted) -> bool:
    """Return True if the narrow band dies away sooner than a tremor does."""
    return fitted.noise.band_s(fitted.problem.setup.grid.step_s) < thresholds.SHORTEST_WAVE_S


def _contradicted(before: HeldOutError | None, after: HeldOutError) -> bool:
    """Return True if the error on held-out pulses shows that structure is left."""
    if after.ratio < thresholds.HELD_OUT_RATIO:
        return False
    return before is None or after.excess_nm > thresholds.HELD_OUT_SHARE * before.excess_nm


def _held_out(search: EffectSearch, notes: list[str]) -> tuple[HeldOutError | None, bool]:
    """The last model's error on held-out pulses, and whether it shows that structure is left; then with a note."""
    before, after = (held_out_error(fitted, search.last) for fitted in (_first(search), search.last))
    contradicted = after is not None and _contradicted(before, after)
    if after is not None and contradicted:
        notes.append(
            f"On held-out pulses the error of the last model is {after.ratio:.1f} times what noise and its uncertainty "
            "allow: something is still missing."
        )
    return after, contradicted


def _first(search: EffectSearch) -> Fitted:
    """The model from which it is measured what effects explain."""
    return search.plain if search.base_effects else search.start.searched


def _explained(search: EffectSearch) -> float:
    """Share of the explainable log-likelihood that the effects explain."""
    first = _first(search)
    possible = search.residual.ideal - first.log_likelihood
    return float((search.last.log_likelihood - first.log_likelihood) / max(possible, 1.0))


def _notes(search: EffectSearch) -> list[str]:
    readings = search.raw.readings
    return [*([] if readings is None else [readings.words]), *likelihood_warnings(search.last)]


def judge(search: EffectSearch) -> Verdict:
    """The verdict on a search for effects."""
    last, residual, notes = search.last, search.residual, _notes(search)
    effects = [*search.base_effects, *search.names("detected", "library")]
    probabilities: dict[str, float] = dict.fromkeys(search.names("detected"), 0.99)
    rivals: dict[str, dict[str, float]] = {}
    objections: dict[str, str] = {}
    largest = 1.0  # a later effect is at most as probable as those before it
    for before, step in search.found:
        effect = str(step.added)
        rivals[effect] = _rivals(search, step)
        repairs = resembles_earlier(before.searched, find_effect(effect), _stage(step), search.names("detected"))
        if repairs or only_at_work(search.quiet, step.searched, effect):
            largest = min(largest, thresholds.UNSURE)
        if objection := vetoed(before.searched, step.searched):
            notes.append(f"The error on held-out pulses rises with this effect: {find_effect(effect).name}.")
        elif find_effect(effect).band and _swings(step.searched):
            objection = "Its wave dies away so soon that the pulses may set it off: a limb may swing."
        if objection:
            objections[effect] = objection
            largest = min(largest, thresholds.DOUBTED)
        probabilities[effect] = largest = min(largest, rivals[effect][effect])
    explained = _explained(search) if effects else 0.0
    if last.noise.band > 0.0:
        # The narrow band itself is not structure: what counts is what remains beside it.
        first = residual_structure(search.start.searched, search.quiet)
        power = max(first.busy_nm**2 - residual.white_nm**2, 1e-12)
        explained = 1.0 - max(residual.busy_nm**2 - residual.white_nm**2, 0.0) / power
    error, contradicted = _held_out(search, notes)
    free = bool(search.names("free")) and not search.found
    if contradicted or free or _strange(search, effects, explained):
        probabilities = {effect: min(p, thresholds.DOUBTED) for effect, p in probabilities.items()}
        kind, probability = "unexplained_structure", 0.9
    elif probabilities:
        kind, probability = "effect_missing", max(probabilities.values())
    else:
        kind, probability = "nothing_missing", _nothing(search.rounds[0] if search.rounds else [])
    return Verdict(
        kind,
        probabilities,
        rivals,
        float(explained),
        float(residual.ratio),
        float(probability),
        error,
        notes,
        objections,
    )


def leaves_more(search: EffectSearch, verdict: Verdict) -> bool:
    """Return True if the last model leaves more than noise: its effects may be true, and another one missing."""
    error, setup = verdict.held_out_error, search.last.problem.setup
    noise_nm = setup.grid.mean_noise_nm(setup.fitted)
    unseen = error is not None and error.ratio > thresholds.NAMED_BUT
    return unseen or search.residual.significant or search.last.rms_nm > thresholds.NAMED_BUT * noise_nm


def _rivals(search: EffectSearch, step: Step) -> dict[str, float]:
    """Probabilities of the effects tried in the round of a step, without those of other rounds."""
    others = {*search.names("library")} - {step.added}
    competitors = [c for c in step.tried if c.refusal is None and c.effect.id not in others]
    return shares(competitors, next(c.gain for c in competitors if c.effect.id == step.added))


def _stage(step: Step) -> str:
    """The stage of the form that was added; of a narrow band, the first form's."""
    added = find_effect(str(step.added))
    return dict(step.searched.effects).get(added.id, added.forms[0]).stage


def _strange(search: EffectSearch, effects: list[str], explained: float) -> bool:
    """Return True if the fitted rows show that structure is left."""
    residual, readings = search.residual, search.raw.readings
    if readings is not None and readings.held_s > LONGEST_HELD_S:
        return True
    required = thresholds.LEAST_EXPLAINED
    if effects and find_effect(effects[0]).band:
        required = thresholds.LEAST_EXPLAINED_BY_BAND
    if explained < required and residual.significant:
        return True
    return bool(search.found) and find_effect(str(search.found[0][1].added)).sporadic and _no_effort(search)
