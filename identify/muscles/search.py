"""What a model of several muscles lacks: their interplay first, then the effects of each muscle.

Interplay is tried on all muscles at once. An effect of one muscle is looked for as in a record of that muscle alone,
with the others' torque taken away, and then judged on all at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import Progress, search_effects, silent
from stimrig.identify.diagnosis.verdict import judge
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.fit_statistics import rms
from stimrig.identify.estimation.left_out import difference, leave_out
from stimrig.identify.muscles.interplay import registry
from stimrig.identify.muscles.joint_fit import JointFitted, fit_all
from stimrig.identify.muscles.problem import Acting
from stimrig.identify.muscles.record import JointRecord

MARGIN = 6.0
"""Log evidence that an interplay or an effect must gain."""
LEAST_SHARE = 0.004
"""An interplay that changes the torque by less than this share of its spread where it acts is none: an inexact curve
looks like it."""
MOST_EFFECTS = 3
JOINT_STAGES = {"additive"}
"""An effect of these stages is of the joint, not of one muscle; it is kept with the first channel."""


@dataclass(frozen=True)
class Tried:
    """One thing that was tried beside a model."""

    key: str  # "cross_talk:biceps>triceps", "co_contraction", "biceps.fatigue"
    form: str
    found: JointFitted  # with it
    gain: float  # of log evidence, with its prior odds


@dataclass(frozen=True)
class Refused:
    """Why something that was tried was not added."""

    gain: float  # of log evidence, with its prior odds
    reason: str


NOTHING = Refused(0.0, "The evidence does not ask for it.")


@dataclass
class JointSearch:
    """The models, each with one thing more, and what was tried and not added."""

    chain: list[JointFitted]  # the first one, and the model with each of `added`
    added: list[Tried] = field(default_factory=list)
    refused: dict[str, Refused] = field(default_factory=dict)  # by key
    unexplained: list[str] = field(default_factory=list)  # muscles whose own record keeps structure

    @property
    def last(self) -> JointFitted:
        """The model with all that was found."""
        return self.chain[-1]

    def append(self, one: Tried) -> None:
        """Go on from the model with it."""
        self.added.append(one)
        self.chain.append(one.found)


def search(record: JointRecord, progress: Progress | None = None, base: JointFitted | None = None) -> JointSearch:
    """Add interplay and effects to the model of a record while the evidence asks for them.

    Parameters
    ----------
    record : JointRecord
        What was measured.
    progress : callable or None
        Called with the share done, 0 to 1, and a line of text; it may raise `Cancelled`.
    base : JointFitted, optional
        The model to start from; by default the plain structure of all muscles.
    """
    say = progress or silent
    say(0.02, "fitting all muscles")
    found = JointSearch([base or fit_all(record)])
    while (best := _best(found, _interplays(found.last))) is not None:
        found.append(best)
        say(min(0.1 + 0.05 * len(found.added), 0.3), f"added {best.key}")
    for number in range(MOST_EFFECTS):
        best = _best(found, _effects(found, say, number))
        if best is None:
            break
        found.append(best)
        while (more := _best(found, _interplays(found.last))) is not None:
            found.append(more)
    drop_idle(found)
    return found


def _best(found: JointSearch, candidates: Sequence[Tried]) -> Tried | None:
    """The likeliest of a round that held-out pulses do not speak against; None if none gains enough."""
    ranked = sorted(candidates, key=lambda one: (-one.gain, one.key))
    for one in ranked:
        if found.refused.get(one.key, NOTHING).reason == NOTHING.reason:
            found.refused[one.key] = Refused(one.gain, NOTHING.reason)
    for one in ranked:
        if one.gain < MARGIN:
            break
        reason = _objection(found.last, one)
        if reason is None:
            return one
        found.refused[one.key] = Refused(one.gain, reason)
    return None


def _objection(last: JointFitted, one: Tried) -> str | None:
    """What blocks that are left out, or held-out pulses, say against a candidate; None where they do not."""
    known = find_effect(one.key.partition(".")[2]) if "." in one.key else None
    if known is None or known.predictable:
        seen = difference(leave_out(last.fitted), leave_out(one.found.fitted))
        if not seen.errors >= thresholds.BETTER:
            return seen.words
    return vetoed(last.fitted, one.found.fitted)


def _interplays(last: JointFitted) -> list[Tried]:
    names = last.record.names
    present = {acting.key(names) for acting in last.acting}
    tried: list[Tried] = []
    for interplay in registry().values():
        ends: list[Any] = list(permutations(range(len(names)), 2)) if interplay.directed else [None]
        for between in ends:
            forms = [Acting(interplay, form.name, between) for form in interplay.forms]
            if forms[0].key(names) in present or not _can_act(last, forms[0]):
                continue
            best = last.with_likeliest(forms)
            if _size(last, best) >= LEAST_SHARE:
                tried.append(_tried(last, forms[0].key(names), best.acting[-1].form, best))
    return tried


def _can_act(last: JointFitted, acting: Acting) -> bool:
    """Co-contraction needs muscles that pull against each other."""
    signs = last.problem.signs
    return acting.between is not None or bool(np.any(signs > 0) and np.any(signs < 0))


def _tried(last: JointFitted, key: str, form: str, found: JointFitted) -> Tried:
    """With what it gains; all kinds of interplay are equally likely before, effects are not."""
    prior = find_effect(key.partition(".")[2]).prior if "." in key else 0.0
    return Tried(key, form, found, found.fitted.log_evidence - last.fitted.log_evidence + prior)


def _size(before: JointFitted, after: JointFitted) -> float:
    """How much the prediction changes where several muscles are at work, as a share of the torque's spread there."""
    moving = np.sum([one.pulse_width_us > 0 for one in before.grids], axis=0) > 1
    rows = before.problem.setup.fitted & moving
    if not rows.any():
        return 0.0
    change = before.fitted.residual_nm - after.fitted.residual_nm
    return rms(change[rows]) / max(float(np.std(before.problem.setup.target_nm[rows])), 1e-9)


def _effects(found: JointSearch, say: Progress, number: int) -> list[Tried]:
    """What each muscle's own record asks for, fitted on all muscles at once."""
    last, tried = found.last, []
    found.unexplained.clear()
    for place, name in enumerate(last.record.names):
        view = last.views[place]
        begin = 0.3 + 0.6 * (number + place / len(last.grids)) / MOST_EFFECTS
        step = 0.6 / MOST_EFFECTS / len(last.grids)
        tell = _within(say, begin, step, name)
        raw = replace(
            last.raw, torque_nm=view.problem.setup.grid.record.torque_nm, hum=None, ceiling_nm=None, floor_nm=None
        )
        held = [f"{effect}:{form.name}" for effect, form in last.effects[place]]
        own = search_effects(view.problem.setup.grid, raw, last.problem.setup.fitted, tell, most=1, structure=held)
        verdict = judge(own)
        if verdict.kind == "unexplained_structure":
            found.unexplained.append(name)
        for effect in own.added:
            if find_effect(effect).band:
                continue
            form = dict(own.last.effects)[effect]
            where, whose = (0, "joint") if form.stage in JOINT_STAGES else (place, name)
            if effect in dict(last.effects[where]) or f"{whose}.{effect}" in {one.key for one in tried}:
                continue
            both = last.with_effect(where, effect, form, own.last.parameters_of(effect))
            tried.append(_tried(last, f"{whose}.{effect}", form.name, both))
    return tried


def _within(say: Progress, begin: float, step: float, name: str) -> Progress:
    return lambda share, text: say(begin + step * share, f"{name}: {text}")


def drop_idle(found: JointSearch) -> None:
    """Take away each interplay that later ones have made idle, and with it the models that still hold it."""
    for one in [one for one in found.added[:-1] if "." not in one.key]:
        without = found.last.without(one.key)
        if found.last.fitted.log_evidence - without.fitted.log_evidence >= MARGIN:
            continue
        place = found.added.index(one)
        later, chain = found.added[place + 1 :], [without]
        for each in later[:0:-1]:
            chain.insert(0, chain[0].without(each.key))
        del found.added[place:], found.chain[place + 1 :]
        for each, fitted in zip(later, chain, strict=True):
            found.append(_tried(found.last, each.key, each.form, fitted))


def probability(found: JointSearch, one: Tried) -> float:
    """That this is there, and not one of its rivals, by the evidence: of models with and without it."""
    last, without = found.last, found.last.without(one.key)
    rivals = [without.fitted.log_evidence]
    for rival in rivals_of(one.key):
        rivals += [each.found.fitted.log_evidence for each in _interplays(without) if each.key.startswith(rival)]
    lost = [last.fitted.log_evidence - other for other in rivals]
    return 1.0 / (1.0 + sum(math.exp(-min(max(each, -50.0), 50.0)) for each in lost))


def rivals_of(key: str) -> tuple[str, ...]:
    """Ids of interplay that a record often cannot separate from it."""
    identifier = key.partition(":")[0]
    return registry()[identifier].resembles if identifier in registry() else ()
