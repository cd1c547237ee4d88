"""The verdict of a search for effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stimrig.identify.conclusion import PROBABLE
from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.objections import objection_to
from stimrig.identify.diagnosis.probability import Scores, probability, scores_of_effect, scores_of_remainder
from stimrig.identify.diagnosis.residual import HeldOutError, Remainder, held_out_error, residual_structure
from stimrig.identify.diagnosis.search import EffectSearch, Step, only_at_work
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.candidates import likelihood_warnings
from stimrig.identify.estimation.contradiction import contradiction
from stimrig.identify.estimation.effect_fit import Candidate, effect_names
from stimrig.identify.estimation.solve import Fitted

LONGEST_HELD_S = 0.05
"""A reading that is held for longer than two pulses hides how the torque rises and falls."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on a search for effects."""

    kind: str  # "effect_missing", "nothing_missing" or "unexplained_structure"
    probability: float  # of the verdict as a whole
    probabilities: dict[str, float]  # by effect, of those added
    remaining: float  # probability that something else is missing
    nothing: float  # probability that nothing is missing
    rivals: dict[str, dict[str, float]] = field(default_factory=dict)
    """For each effect found: the shares of all effects tried in the same round."""
    objections: dict[str, str] = field(default_factory=dict)  # by effect: what speaks against it
    doubted: dict[str, float] = field(default_factory=dict)
    """Probabilities of the effects that were found and are not named."""


def shares(candidates: Sequence[Candidate], max_gain: float = np.inf) -> dict[str, float]:
    """Share of probability of each candidate, and under the key "" that none of them is there.

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
    return {name: weight / total for name, weight in weights.items()}


@dataclass(frozen=True)
class Examined:
    """What is known of an effect that a search found."""

    shares: dict[str, float]  # of all effects tried in the same round
    objection: str | None  # what speaks against it
    scores: Scores


def examine(search: EffectSearch) -> dict[str, Examined]:
    """Return what is known of each effect that a search found, the doubted ones last."""
    examined = {}
    for before, step in [*search.found, *search.open]:
        shares_there, objection = _rivals(search, step), objection_to(before, step)
        scores = scores_of_effect(search, before, step, shares_there[str(step.added)], objection is not None)
        examined[str(step.added)] = Examined(shares_there, objection, scores)
    return examined


def judge(search: EffectSearch) -> Verdict:
    """The verdict on a search that has ended."""
    examined, doubted = examine(search), {str(step.added) for step in search.doubted}
    chances = dict.fromkeys(search.names("detected"), probability("seen", {}))
    chances |= {effect: probability("missing", each.scores) for effect, each in examined.items()}
    remaining, free = probability("left", scores_of_remainder(search)), bool(search.names("free"))
    nothing = (1.0 - remaining) * float(np.prod([1.0 - chance for chance in chances.values()]))
    named = {effect: each for effect, each in examined.items() if effect not in doubted}
    probabilities = {effect: chance for effect, chance in chances.items() if effect not in doubted}
    best = max(probabilities.values(), default=0.0)
    if best >= PROBABLE and (named or not free) and not search.remainder.structure:
        kind, certainty = "effect_missing", best
    elif nothing >= PROBABLE and not free:
        kind, certainty = "nothing_missing", nothing
    else:
        kind, certainty = "unexplained_structure", remaining if best >= PROBABLE else 1.0 - nothing
    return Verdict(
        kind,
        certainty,
        probabilities,
        remaining,
        nothing,
        rivals={effect: each.shares for effect, each in named.items()},
        objections={effect: each.objection for effect, each in named.items() if each.objection},
        doubted={effect: chances[effect] for effect in doubted},
    )


def remainder_of(search: EffectSearch) -> Remainder:
    """Look at what the last model of a search leaves, by rules; `judge` makes probabilities of it."""
    last, residual, readings = search.last, search.residual, search.raw.readings
    effects = [*search.base_effects, *search.names("detected", "library")]
    explained = _explained(search) if effects else 0.0
    if last.noise.band > 0.0:
        # The narrow band itself is not structure: what counts is what remains beside it.
        first = residual_structure(search.start.searched, search.quiet)
        power = max(first.busy_nm**2 - residual.white_nm**2, 1e-12)
        explained = 1.0 - max(residual.busy_nm**2 - residual.white_nm**2, 0.0) / power
    before, after = (held_out_error(fitted, last) for fitted in (_first(search), last))
    contradicted = after is not None and _contradicted(before, after)
    notes = [*([] if readings is None else [readings.words]), *likelihood_warnings(last)]
    if after is not None and contradicted:
        notes.append(
            f"On held-out pulses the error of the last model is {after.ratio:.1f} times what noise and its uncertainty "
            "allow: something is still missing."
        )
    present, pairs = effect_names(last), (contradiction(last) or {"pairs": None})["pairs"]
    tried = next(reversed(search.rounds), ())
    return Remainder(
        structure=contradicted or _strange(search, effects, explained),
        explained=float(explained),
        ratio=float(residual.ratio),
        white_nm=residual.white_nm,
        held_out=after,
        contradiction=pairs and pairs[0]["statistic"] / pairs[0]["limit"],
        open_gain=max((candidate.gain for candidate in tried if candidate.effect.id not in present), default=0.0),
        notes=tuple(notes),
    )


def _no_effort(search: EffectSearch) -> bool:
    """Return True if apparent efforts are more likely caused by the stimulation."""
    step = search.found[0][1]
    effort, holder = str(step.added), step.searched
    return only_at_work(search.quiet, holder, effort) and "resisting" in dict(holder.effects)[effort].name


def _contradicted(before: HeldOutError | None, after: HeldOutError) -> bool:
    """Return True if the error on held-out pulses shows that structure is left."""
    if after.ratio < thresholds.HELD_OUT_RATIO:
        return False
    return before is None or after.excess_nm > thresholds.HELD_OUT_SHARE * before.excess_nm


def _first(search: EffectSearch) -> Fitted:
    """The model from which it is measured what effects explain."""
    return search.plain if search.base_effects else search.start.searched


def _explained(search: EffectSearch) -> float:
    """Share of the explainable log-likelihood that the effects explain."""
    first = _first(search)
    possible = search.residual.ideal - first.log_likelihood
    return float((search.last.log_likelihood - first.log_likelihood) / max(possible, 1.0))


def leaves_more(search: EffectSearch) -> bool:
    """Return True if the last model leaves more than noise: its effects may be true, and another one missing."""
    error, setup = search.remainder.held_out, search.last.problem.setup
    noise_nm = setup.grid.mean_noise_nm(setup.fitted)
    unseen = error is not None and error.ratio > thresholds.NAMED_BUT
    return unseen or search.residual.significant or search.last.rms_nm > thresholds.NAMED_BUT * noise_nm


def _rivals(search: EffectSearch, step: Step) -> dict[str, float]:
    """Shares of the effects tried in the round of a step, without those of other rounds."""
    others = {*effect_names(search.last)} - {step.added}
    competitors = [c for c in step.tried if c.refusal is None and c.effect.id not in others]
    return shares(competitors, next(c.gain for c in competitors if c.effect.id == step.added))


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
