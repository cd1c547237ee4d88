"""From evidence to a verdict with probabilities, calibrated on development records (docs/diagnosis.md)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from identify.diagnosis.analysis import Analysis, seen_at_rest
from identify.diagnosis.structure import held_readings
from identify.diagnosis.thresholds import (
    APART_S,
    DOUBTED,
    EVERYWHERE,
    EXPLAINED_BY_LAWS,
    FIRST_MARGIN,
    FORM,
    FORM_OF_EFFECTS,
    HELD,
    LAPSE,
    LEAST_BY_BAND,
    LEAST_BY_EFFORTS,
    LEAST_EXPLAINED,
    MANY,
    NAMELESS,
    ONLY_AT_WORK,
    RELATIVE,
    SEEN_AT_REST,
    STRUCTURE,
    TEMPERATURE,
    UNSEEN_RATIO,
    UNSEEN_SHARE,
    UNSTEADY,
)
from identify.diagnosis.unseen import Unseen, rise, unseen
from identify.effects import get
from identify.estimation.adding import Candidate


@dataclass(frozen=True)
class Verdict:
    """What a record says.

    Parameters
    ----------
    kind : str
        "effect_missing", "nothing_missing" or "unexplained_structure".
    found : dict
        Probability by effect, of those added.
    rivals : dict
        Probability by effect of all that were tried in the round in which each was added.
    explained : float
        Share of the explicable log-likelihood that the effects took.
    structure : float
        Log-likelihood by which work and rest still differ.
    probability : float
        Of the verdict as a whole.
    unseen : Unseen or None
        What the rows not seen say of the last model; None where they can say nothing.
    contradicted : bool
        Whether they say that structure is left.
    notes : list of str
        Reasons, for people.
    """

    kind: str
    found: dict[str, float]
    rivals: dict[str, dict[str, float]]
    explained: float
    structure: float
    probability: float
    unseen: Unseen | None = None
    contradicted: bool = False
    notes: list[str] = field(default_factory=list)


def shares(candidates: list[Candidate]) -> dict[str, float]:
    """Probability of each candidate, given that one of them is there, and of none ("")."""
    if not candidates:
        return {"": 1.0}
    top = candidates[0].gain
    spread = TEMPERATURE + RELATIVE * max(top, 0.0)
    weights = {c.effect.id: float(np.exp(max((c.gain - top) / spread, -60.0))) for c in candidates}
    # At the margin an effect is as likely there as not.
    weights[""] = float(np.exp(np.clip(FIRST_MARGIN - top, -60.0, 60.0)))
    total = sum(weights.values())
    return {name: (1.0 - LAPSE) * weight / total for name, weight in weights.items()}


def _nothing(candidates: list[Candidate]) -> float:
    """Probability that none of the candidates is there."""
    return 1.0 / (1.0 + sum(float(np.exp(min(c.gain - FIRST_MARGIN, 60.0))) for c in candidates))


def _no_effort(work: Analysis, explained: float, structure: float) -> bool:
    """Whether what looks like efforts is more likely something the stimulation does."""
    if explained < LEAST_BY_EFFORTS and structure > STRUCTURE:
        return True
    effort = work.added[0]
    holder = work.chain[1]
    if seen_at_rest(work.quiet, holder, effort) >= SEEN_AT_REST:
        return False
    return "resisting" in dict(holder.effects)[effort].name or _efforts(holder.parameters_of(effort)) >= MANY


def _only_at_work(work: Analysis, number: int) -> bool:
    """Whether an added torque that nobody can foresee is seen nowhere in the rests."""
    effect, holder = work.added[number], work.chain[number + 1]
    form = dict(holder.effects).get(effect)
    if form is None or form.stage != "additive" or get(effect).foreseeable:
        return False
    return seen_at_rest(work.quiet, holder, effect) < SEEN_AT_REST


def _everywhere(work: Analysis) -> bool:
    """Whether what looks like efforts lasts for much of the test: efforts are seldom."""
    effort = work.added[0]
    holder = work.chain[1]
    widths = [value for name, value in holder.parameters_of(effort).items() if name.startswith(("width_", "decay_"))]
    setup = holder.problem.setup
    return 2.0 * sum(widths) > EVERYWHERE * float(setup.fitted.sum()) * setup.grid.step_s


def _efforts(parameters: dict[str, float]) -> int:
    """How many efforts the bumps make: those close to one another are one."""
    centres = np.sort([value for name, value in parameters.items() if name.startswith("centre_")])
    return int(np.sum(np.diff(centres) > APART_S)) + 1 if centres.size else 0


def _contradicted(before: Unseen | None, after: Unseen) -> bool:
    """Whether the rows not seen say that something is left, whatever the fitted rows say."""
    if after.ratio < UNSEEN_RATIO:
        return False
    return before is None or after.excess_nm > UNSEEN_SHARE * before.excess_nm


def judge(work: Analysis) -> Verdict:
    """The verdict on an analysis."""
    first, last = work.plain if work.held else work.chain[0], work.last
    effects = [*work.held, *work.added]
    left = work.left[-1]
    possible = max(left.ideal - first.log_likelihood, 1.0)
    explained = (last.log_likelihood - first.log_likelihood) / possible if effects else 0.0
    held = held_readings(work.record)
    notes: list[str] = []
    found: dict[str, float] = dict.fromkeys(work.given, 0.99)
    rivals: dict[str, dict[str, float]] = {}
    for number, effect in enumerate(work.added):
        rivals[effect] = shares(
            [c for c in work.rounds[number] if c.effect.id == effect or c.effect.id not in work.added]
        )
        # What was added later stands on what was added before.
        found[effect] = min([rivals[effect].get(effect, 0.5), *(found[e] for e in work.added[:number] if e in found)])
        if _only_at_work(work, number):
            found[effect] = min(found[effect], ONLY_AT_WORK)
        if rise(work.chain[number], work.chain[number + 1]) is not None:
            found[effect] = min(found[effect], DOUBTED)
            notes.append(f"{get(effect).name}: the error on rows not seen rises with it.")
    structure = left.ratio
    if last.noise.band > 0.0:
        # The band's own surprise isn't structure: what counts is what remains beside it.
        before = max(work.left[0].busy_nm ** 2 - left.white_nm**2, 1e-12)
        explained = 1.0 - max(left.busy_nm**2 - left.white_nm**2, 0.0) / before
    strange = held > HELD
    if strange:
        notes.append(f"{100 * held:.0f} % of the readings repeat the one before exactly: the converter holds or steps.")
    if effects:
        strange = strange or (explained < LEAST_EXPLAINED and structure > STRUCTURE)
        lawless = work.nameless[0] > work.rounds[0][0].gain + NAMELESS
        strange = strange or (lawless and explained < EXPLAINED_BY_LAWS)
        if get(effects[0]).band:
            strange = strange or (explained < LEAST_BY_BAND and structure > UNSTEADY)
        elif work.added and not get(work.added[0]).foreseeable:
            strange = strange or _everywhere(work) or _no_effort(work, explained, structure)
    else:
        strange = strange or structure > STRUCTURE
    # Who names an effect says more than who names none, and is held to more.
    form = FORM_OF_EFFECTS if effects else FORM
    before, after = (unseen(fitted, form, last) for fitted in (first, last))
    contradicted = after is not None and _contradicted(before, after)
    if after is not None and contradicted:
        strange = True
        notes.append(
            f"On rows not seen the last model errs by {after.ratio:.1f} times what noise and its own uncertainty "
            "allow: structure is left."
        )
    if strange:
        found = {effect: min(p, DOUBTED) for effect, p in found.items()}
        kind = "unexplained_structure"
        probability = 0.9
    elif found:
        kind, probability = "effect_missing", max(found.values())
    else:
        kind, probability = "nothing_missing", _nothing(work.rounds[0] if work.rounds else [])
    return Verdict(
        kind, found, rivals, float(explained), float(structure), float(probability), after, contradicted, notes
    )
