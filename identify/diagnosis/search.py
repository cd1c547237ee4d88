"""The search for effects: a chain of models, each with one effect more, as long as the evidence is sufficient."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stimrig.identify.diagnosis import thresholds
from stimrig.identify.diagnosis.candidates import FREE_GAIN, Progress, scan
from stimrig.identify.diagnosis.residual_structure import ResidualStructure, quiet_rows, residual_structure
from stimrig.identify.effects import get, registry
from stimrig.identify.effects.base import Effect
from stimrig.identify.estimation.effect_fit import (
    BAND_COST,
    Candidate,
    detected_effects,
    effect_names,
    fit_form,
    fit_from,
    renewed_curve,
    try_effect,
    with_effects,
)
from stimrig.identify.estimation.joint import Fitted, solve, start_from
from stimrig.identify.estimation.plain import fit_plain, fitted_rows, prepare
from stimrig.identify.estimation.samples import Raw
from stimrig.identify.noise import NoiseLevel
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.problem import Problem

MOST = 3
"""Effects at most."""


@dataclass
class EffectSearch:
    """What was tried on a record, and with what result.

    Parameters
    ----------
    record : Record
        The record, as given.
    raw : Raw
        What the samples show before any fit.
    plain : Fitted
        The model without effects.
    base : Fitted
        The model of the structure that is examined.
    detected : list of str
        Effects that the samples show before any fit.
    with_detected : list of Fitted
        The base with the first of them, with the first two, ….
    rounds : list of list of Candidate
        Candidates of each round, best first; round i starts from chain[i].
    chain : list of Fitted
        The base (with what was detected), then with one effect more each time.
    added : list of str
        Effects added, in order.
    margins : list of float
        Log evidence required in each round.
    free_gain : list of float
        Log evidence for a gain that varies without a law, in each round.
    losses : dict
        Log evidence lost without each effect, if there are several.
    quiet : ndarray of bool
        Intervals in which the muscle rests.
    residuals : list of ResidualStructure
        What the residual of each model of the chain shows.
    """

    record: Record
    raw: Raw
    plain: Fitted
    base: Fitted
    detected: list[str] = field(default_factory=list)
    with_detected: list[Fitted] = field(default_factory=list)
    rounds: list[list[Candidate]] = field(default_factory=list)
    chain: list[Fitted] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)
    free_gain: list[float] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    quiet: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    residuals: list[ResidualStructure] = field(default_factory=list)

    @property
    def held(self) -> list[str]:
        """Effects of the structure that is examined."""
        return effect_names(self.base)

    @property
    def last(self) -> Fitted:
        """The model with all effects found."""
        return self.chain[-1]


def search_effects(
    record: Record,
    progress: Progress | None = None,
    *,
    most: int = MOST,
    effects: Iterable[Effect] | None = None,
    fitted: np.ndarray | None = None,
    structure: Sequence[str] = (),
) -> EffectSearch:
    """Try all effects on a record, add the best, and continue while the evidence is sufficient.

    Parameters
    ----------
    record : Record
        What was measured.
    progress : callable or None
        Called with the share done and a line of text; it may raise `Cancelled`.
    most : int
        Effects to add at most.
    effects : iterable of Effect or None
        Effects to try; the whole library by default.
    fitted : ndarray of bool or None, shape (K,)
        Pulse intervals to fit; by default all that may be fitted.
    structure : sequence of str
        Effects, "id" or "id:form", that the examined model already has.
    """
    listed = list(registry().values() if effects is None else effects)
    grid, raw = prepare(record)
    plain_fit = fit_plain(grid, fitted_rows(grid, None) if fitted is None else fitted)
    base = renewed_curve(with_effects(plain_fit, structure, raw))
    search = EffectSearch(record, raw, plain_fit, base)
    start = _with_detected(search, base)
    search.chain, search.quiet = [start], quiet_rows(start)
    search.residuals = [residual_structure(start, search.quiet, raw.noise_sd_nm)]
    for number in range(most):
        if number and _exhausted(search):
            break
        before = search.rounds[0] if search.rounds else None
        candidates = scan(search.last, listed, progress, (0.1 + 0.3 * number, 0.4 + 0.3 * number), before)
        candidates = sorted((_discounted(search, c) for c in candidates), key=lambda c: -c.gain)
        search.rounds.append(candidates)
        free_gain = try_effect(FREE_GAIN, search.last)
        search.free_gain.append(free_gain.gain if free_gain else 0.0)
        search.margins.append(_margin(search, len(search.added)))
        enough = [c for c in candidates if c.gain >= _margin(search, len(search.added), c)]
        if not enough:
            break
        _append(search, enough[0].fitted, enough[0].effect.id)
        if number:
            _exchange(search)
    if len(search.added) > 1:
        for effect in search.added:
            without = without_effect(search.last, effect)
            search.losses[effect] = search.last.log_evidence - without.log_evidence
    return search


def seen_at_rest(quiet: np.ndarray, fitted: Fitted, effect: str) -> float:
    """Size of an added torque at rest, divided by its size at work. Efforts come at any time, stimulated or not."""
    setup = fitted.problem.setup
    form = next(form for name, form in fitted.effects if name == effect)
    values = {name: np.array([[value]]) for name, value in fitted.parameters_of(effect).items()}
    torque = np.broadcast_to(form.call(None, values, setup.scene), (1, quiet.size))[0]
    parts = [
        np.mean(torque[rows] ** 2) if np.any(rows) else 0.0 for rows in (setup.fitted & quiet, setup.fitted & ~quiet)
    ]
    return float(np.sqrt(parts[0] / max(parts[1], 1e-30)))


def _discounted(search: EffectSearch, candidate: Candidate) -> Candidate:
    """The candidate with its gain reduced if it is an effort, and reduced more if it is only seen at work."""
    if candidate.effect.predictable or candidate.effect.band:
        return candidate
    seen = candidate.form.stage != "additive" or _at_rest(search, candidate)
    return replace(
        candidate, gain=(thresholds.EFFORT_WEIGHT if seen else thresholds.EFFORT_WEIGHT_ONLY_AT_WORK) * candidate.gain
    )


def _at_rest(search: EffectSearch, candidate: Candidate) -> bool:
    return seen_at_rest(search.quiet, candidate.fitted, candidate.effect.id) >= thresholds.SEEN_AT_REST


def _margin(search: EffectSearch, number: int, candidate: Candidate | None = None) -> float:
    """Log evidence that an effect must gain in a round: more where it may only repair the first one's inexact form."""
    if not number and not search.held:
        return thresholds.FIRST_MARGIN
    return max(
        thresholds.NEXT_MARGIN,
        (thresholds.NEXT_SHARE if candidate is None else _required_share(search, candidate)) * _first_gain(search),
    )


def _first_gain(search: EffectSearch) -> float:
    """Log evidence gained by the first effect, or by those of the structure; 0 for a narrow band, which is noise."""
    if search.held:
        return (
            0.0 if any(get(name).band for name in search.held) else search.base.log_evidence - search.plain.log_evidence
        )
    return 0.0 if search.rounds[0][0].effect.band else search.rounds[0][0].gain


def _required_share(search: EffectSearch, candidate: Candidate) -> float:
    """Share of the first effect's gain that a further effect must gain."""
    effect, stage = candidate.effect, candidate.form.stage
    if not effect.predictable:
        return thresholds.UNPREDICTABLE_SHARE
    if stage == "additive":
        return 0.5 * thresholds.CONFIRMED_SHARE
    if stage in ("gain", "pulse_width") and search.free_gain[-1] > thresholds.FREE_GAIN_CONFIRMS * candidate.gain:
        return thresholds.CONFIRMED_SHARE
    for name, form in search.last.effects:
        if name in search.detected:
            continue
        if form.stage in thresholds.DYNAMIC and stage in thresholds.DYNAMIC:
            return thresholds.SIMILAR_SHARE
        if name in effect.resembles or effect.id in get(name).resembles:
            return thresholds.SIMILAR_SHARE
    return thresholds.NEXT_SHARE


def _append(search: EffectSearch, fitted: Fitted, effect: str) -> None:
    search.added.append(effect)
    search.chain.append(fitted)
    search.residuals.append(residual_structure(fitted, search.quiet, search.raw.noise_sd_nm))


def _exhausted(search: EffectSearch) -> bool:
    """Whether no further effect can gain enough: the residual is nearly as small and as white as noise can be."""
    left, last = search.residuals[-1], search.last
    if last.noise.ar1 > thresholds.SLOWEST_AR1 and left.slow_nm > left.white_nm:
        return False  # such slow noise may be a drift: the rests cannot tell how small the residual could be
    least = max(thresholds.NEXT_MARGIN, thresholds.CONFIRMED_SHARE * _first_gain(search))
    return left.ideal - last.log_likelihood < least and left.ratio < least


def _with_detected(search: EffectSearch, base: Fitted) -> Fitted:
    """The base model with the effects that the samples show beyond doubt."""
    for effect, form, values in detected_effects(search.raw):
        if effect in effect_names(base):
            continue
        base = fit_from(base, effect, form, values)
        search.detected.append(effect)
        search.with_detected.append(base)
    return base


def _exchange(search: EffectSearch) -> None:
    """After a further effect: replace an earlier one if its rival now does better, or drop it if it is not needed."""
    last = search.last
    for index, effect in enumerate(list(search.added[:-1])):
        rivals = [c for c in search.rounds[index] if c.effect.id not in search.added][:2]
        without = without_effect(last, effect)
        if without.log_evidence > search.last.log_evidence - 1.0:
            search.added.remove(effect)
            _rebuild(search, without)
            return
        for rival in rivals:
            if rival.gain < 0.5 * search.rounds[index][0].gain:
                continue
            if rival.effect.band:
                continue
            found = fit_form(rival.effect, rival.form, without, without.residual_nm, {})
            if found is not None and found.log_evidence > search.last.log_evidence + 2.0:
                won = found.log_evidence - search.last.log_evidence
                search.added[index] = rival.effect.id
                _rebuild(search, found, index, won)
                return


def _rebuild(search: EffectSearch, last: Fitted, index: int = -1, won: float = 0.0) -> None:
    """Set chain, rounds and margins as if the effects of the last model had been added one after the other.

    In round `index` an effect replaced one that had gained more alone; it is better by `won`, in log evidence.
    """
    wanted, tried = search.added, search.rounds[: len(search.added)]
    search.added, search.chain, search.residuals = [], search.chain[:1], search.residuals[:1]
    search.rounds, search.margins, search.free_gain = [], [], search.free_gain[: len(wanted)]
    for number, effect in enumerate(wanted):
        before = search.last
        fitted = last if number == len(wanted) - 1 else _part(last, before, [*effect_names(before), effect])
        known = next((c for c in tried[number] if c.effect.id == effect), None)
        described = get(effect)
        gain = fitted.log_evidence - before.log_evidence + described.prior - (BAND_COST if described.band else 0.0)
        form = dict(fitted.effects).get(effect, described.forms[0])
        found = Candidate(described, form, fitted, gain, (known.forms if known else {}) | {form.name: gain})
        found = _discounted(search, found)
        if fitted is last and found.gain < _margin(search, number, found):
            return  # beside the other effects it no longer gains enough
        # The rivals were fitted beside another model: they are taken to gain at most what the added effect gained.
        most = found.gain - (won if number == index else 0.0)
        rivals = [replace(c, gain=min(c.gain, most)) for c in tried[number] if c.effect.id != effect]
        search.rounds.append(sorted([found, *rivals], key=lambda c: -c.gain))
        search.margins.append(_margin(search, number))
        _append(search, fitted, effect)


def _part(last: Fitted, before: Fitted, kept: list[str]) -> Fitted:
    """The last model with only some of its effects, fitted from their present values."""
    problem = Problem(last.problem.setup, [(effect, form) for effect, form in last.effects if effect in kept])
    noise = last.noise if any(get(name).band for name in kept) else before.noise
    return solve(problem, start_from(problem, last, {}), noise)


def without_effect(fitted: Fitted, effect: str) -> Fitted:
    """The model refitted without one of its effects."""
    noise = fitted.noise
    others = [(e, f) for e, f in fitted.effects if e != effect]
    if len(others) == len(fitted.effects):
        noise = NoiseLevel(noise.ar1, noise.share, noise.sd_nm)
    problem = Problem(fitted.problem.setup, others)
    return solve(problem, start_from(problem, fitted, {}), noise)
