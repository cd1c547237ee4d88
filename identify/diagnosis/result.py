"""The result of a diagnosis: the keys of `diagnose --json`, and sentences for people."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.conclusion import conclude, only_open
from stimrig.identify.criticism import worst_places
from stimrig.identify.diagnosis.search import EffectSearch, Step, helpful, steps
from stimrig.identify.diagnosis.thresholds import CLOSE, RIVAL
from stimrig.identify.diagnosis.verdict import Verdict
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.effect_fit import Candidate, effect_names
from stimrig.identify.estimation.finish import describe_parameters, finish
from stimrig.identify.estimation.joint import predict_fitted
from stimrig.identify.estimation.left_out import difference
from stimrig.identify.estimation.shapes import shape_of
from stimrig.identify.estimation.still import moves
from stimrig.identify.estimation.uncertainty import covariance_of
from stimrig.identify.experiments import NOTHING, Experiment, plan, plan_further
from stimrig.identify.results import Diagnosis
from stimrig.identify.summary import probability, probability_words

MAX_PARAMETERS = 24
"""The wave of a tremor has hundreds."""
STATISTICS = (
    "fit_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "ceiling_percent", "held_out_ceiling_percent",
    "held_out_by", "repetition",
)  # fmt: skip


def diagnosis_of(search: EffectSearch, verdict: Verdict) -> Diagnosis:
    """The `Diagnosis` that a search and its verdict give."""
    record, raw = search.record, search.raw
    row = steps(search)
    base = row[0].statistics
    ranked = _ranked(search, verdict)
    covariance = covariance_of(search.last.written) if ranked or search.free else np.zeros((0, 0))
    missing = [_missing(search, verdict, effect, row, covariance) for effect in ranked]
    free = [_free(search, effect, covariance) for effect in search.free]
    final = row[-1].statistics
    residual = record.torque_nm - predict_fitted(search.base)[0]
    where = worst_places(record, residual, raw.noise_sd_nm, rows=search.base.problem.setup.grid.counted)
    fields: dict[str, Any] = {
        "noise_sd_nm": raw.noise_sd_nm,
        "slow_noise": {
            "sd_nm": search.last.noise.sd_nm * float(np.sqrt(min(search.last.noise.share, 1.0))),
            "ar1": search.last.noise.ar1,
        },
        "base": {key: base[key] for key in STATISTICS},
        "verdict": verdict.kind,
        "probability": verdict.probability,
        "missing": tuple(missing),
        "free": tuple(free),
        "add": tuple(step.added for step in helpful(search)[0] if step.added),
        "deciding_experiment": None,
        "where": tuple(where),
        "with_all": {key: final[key] for key in STATISTICS} | {"noise_sd_nm": final["noise_sd_nm"]},
        "residual_check": _is_noise(search) if verdict.kind == "nothing_missing" else None,
        "explained": verdict.explained,
        "structure_left": verdict.structure,
        "unseen": None
        if verdict.held_out_error is None
        else {"rms_nm": verdict.held_out_error.rms_nm, "allowed_nm": verdict.held_out_error.allowed_nm},
        "candidates": tuple([_candidate(candidate) for candidate in tried] for tried in search.rounds),
        "notes": tuple(verdict.notes),
    }
    fields["deciding_experiment"] = _deciding(search, verdict, fields)
    return Diagnosis(**fields, plain=tuple(_plain(search, fields, row[-1 - len(free)].statistics)))


def _ranked(search: EffectSearch, verdict: Verdict) -> list[str]:
    """Effects by probability, those that the samples show first; then by the log evidence lost without each."""
    return sorted(
        verdict.probabilities,
        key=lambda e: (e not in search.detected, -verdict.probabilities[e], -search.losses.get(e, 0.0)),
    )


def _missing(
    search: EffectSearch, verdict: Verdict, effect: str, row: list[Step], covariance: np.ndarray
) -> dict[str, Any]:
    number = next(i for i, step in enumerate(row) if step.added == effect)
    before, after = row[number - 1].statistics, row[number].statistics
    fitted = search.last.written
    index = [e for e, _ in fitted.effects].index(effect)
    parameters = describe_parameters(fitted, index, covariance)
    rivals = verdict.rivals.get(effect, {})
    named = _close(search, effect)
    ranked = sorted((name for name in rivals if name and name != effect), key=lambda name: -rivals[name])
    confused = [name for name in ranked if rivals[name] >= RIVAL or name in named]
    described = find_effect(effect)
    experiment = _experiment(search, effect, confused)
    return {
        "effect": effect,
        "name": described.name,
        "part": described.part,
        "probability": verdict.probabilities[effect],
        "rms_before_nm": before["rms_nm"],
        "rms_after_nm": after["rms_nm"],
        "held_out_rms_before_nm": before["held_out_rms_nm"],
        "held_out_rms_after_nm": after["held_out_rms_nm"],
        "confused_with": confused,
        "next_experiment": experiment.text if experiment else described.separated_by,
        "next_experiment_plan": experiment and _plan(experiment),
        "form": fitted.effects[index][1].name,
        "equation": fitted.effects[index][1].equation,
        "parameters": dict(list(parameters.items())[:MAX_PARAMETERS]),
        "objection": verdict.objections.get(effect),
        "rival_probabilities": {name: p for name, p in rivals.items() if name and p >= 0.005},
        "plain": described.plain,
    }


def _plan(experiment: Experiment) -> dict[str, Any]:
    return {key: value for key, value in experiment.to_dict().items() if key != "rivals"}


def _deciding(search: EffectSearch, verdict: Verdict, diagnosis: dict[str, Any]) -> dict[str, Any] | None:
    """The test for what is left, or for an effect that the record neither names nor excludes."""
    if _undecided(search, verdict):
        return _plan(plan_further(search.record, search.last))
    best = search.rounds[0][0] if only_open(diagnosis) else None
    if best is None or best.effect.band or best.effect.sporadic:
        return None
    return _plan(plan(search.record, {best.effect.id: best.fitted, NOTHING: search.last}))


def _undecided(search: EffectSearch, verdict: Verdict) -> bool:
    """Return True if a further test is planned for the structure that is left.

    None is planned for a moving joint, which has tests of its own, nor where the curve is a guess or the muscle hardly
    answers: the dose would be a guess, too.
    """
    if verdict.kind != "unexplained_structure":
        return False
    still = search.record.angle_rad is None or not moves(search.last.problem.setup.grid, search.rows)
    return still and finish("maximum-likelihood", search.last).quality["gates"]["torque"]["passed"]


def _is_noise(search: EffectSearch) -> bool:
    """Return True if the residual of the examined model passes the model's own check for noise."""
    model = finish("maximum-likelihood", search.base, statistics=steps(search)[0].statistics)
    return bool(model.quality["gates"]["residual"]["passed"])


def _free(search: EffectSearch, effect: str, covariance: np.ndarray) -> dict[str, Any]:
    """Describe a free effect: its form, parameters and curves, and its left-out error."""
    number = search.added.index(effect)
    fitted = search.last.written
    index = [name for name, _ in fitted.effects].index(effect)
    shape = shape_of(fitted, index, covariance)
    assert shape is not None
    return {
        "effect": effect,
        "name": find_effect(effect).name,
        "form": fitted.effects[index][1].name,
        "equation": fitted.effects[index][1].equation,
        "parameters": describe_parameters(fitted, index, covariance),
        "left_out": difference(search.left_out[number], search.left_out[number + 1]).words_of_choice,
        **{"axis" if key == "effect" else key: value for key, value in shape.items()},
    }


def _close(search: EffectSearch, effect: str) -> set[str]:
    """Effects that resemble this one and gain nearly as much: in another form they might be better."""
    if effect not in search.added:
        return set()
    round_ = search.rounds[search.added.index(effect)]
    gains = {c.effect.id: c.gain for c in round_ if c.refused is None}
    similar = {c.effect.id for c in round_ if effect in c.effect.resembles} | set(find_effect(effect).resembles)
    return {name for name in similar if gains.get(name, 0.0) > CLOSE * gains.get(effect, 0.0)}


def _experiment(search: EffectSearch, effect: str, confused: list[str]) -> Experiment | None:
    """The shortest test that separates an effect from its first rival, both as fitted in the same round."""
    if not confused or effect not in search.added:
        return None
    fits = {c.effect.id: c.fitted for c in search.rounds[search.added.index(effect)]}
    rivals = {name: fits[name] for name in (effect, confused[0]) if name in fits and not find_effect(name).band}
    return plan(search.record, rivals) if len(rivals) == 2 else None


PARTS = {
    "f": "f(u), the recruitment curve",
    "G": "G, the linear dynamics",
    "g": "g(x, ẋ), the active torque over angle and velocity",
    "h": "h(x, ẋ), the passive torque over angle and velocity",
}


def _candidate(candidate: Candidate) -> dict[str, Any]:
    return {
        "effect": candidate.effect.id,
        "name": candidate.effect.name,
        "form": candidate.form.name,
        "log_evidence_gain": candidate.gain,
        "rms_nm": candidate.fitted.rms_nm,
        "forms": candidate.forms,
        "refusal": candidate.refusal,
    }


def _plain(search: EffectSearch, diagnosis: dict[str, Any], named: dict[str, Any]) -> list[str]:
    base, missing = diagnosis["base"], diagnosis["missing"]
    base_names = " and ".join(find_effect(name).name.lower() for name in effect_names(search.base))
    conclusion = conclude(diagnosis)
    lines = [
        f"The model {f'with {base_names}' if base_names else 'without effects'} fits {base['fit_percent']:.1f} %; the "
        f"noise of {diagnosis['noise_sd_nm']:.3g} N·m allows {base['ceiling_percent']:.1f} % at most.",
        f"{conclusion.title}. {conclusion.words}",
        *[
            f"Most of it is here: {place['text']}."
            for place in diagnosis["where"][:1]
            if conclusion.kind == "unexplained"
        ],
        *[f"{row['words']} {row['left_out']}" for row in diagnosis["free"]],
    ]
    for entry in missing:
        chance = entry["probability"]
        text = f"{entry['name']} is {probability_words(chance)} missing ({probability(chance)}). {entry['plain']}"
        if entry["part"]:
            text += f" In the paper's Fig. 2 it stands in {PARTS[entry['part']]}."
        if entry["confused_with"]:
            others = ", ".join(find_effect(name).name.lower() for name in entry["confused_with"])
            text += f" This record cannot clearly separate it from: {others}. To decide: {entry['next_experiment']}"
        lines.append(text)
    if missing and diagnosis["verdict"] == "effect_missing":
        lines.append(
            f"With {'it' if len(missing) == 1 else 'them'} the error on held-out pulses falls from "
            f"{base['held_out_rms_nm']:.3g} to {named['held_out_rms_nm']:.3g} N·m."
        )
    return [*lines, *diagnosis["notes"], conclusion.advice]
