"""The result of a diagnosis: the keys of `diagnose --json`, and sentences for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.conclusion import only_open
from stimrig.identify.criticism import worst_places
from stimrig.identify.diagnosis.changes import table_of
from stimrig.identify.diagnosis.search import EffectSearch, Step, helpful
from stimrig.identify.diagnosis.thresholds import CLOSE, LEAST_RIVAL
from stimrig.identify.diagnosis.verdict import Verdict, judge, leaves_more
from stimrig.identify.effects import Effect, find_effect
from stimrig.identify.estimation.effect_fit import Candidate
from stimrig.identify.estimation.finish import describe_parameters, finish
from stimrig.identify.estimation.left_out import difference
from stimrig.identify.estimation.shapes import shape_of
from stimrig.identify.estimation.solve import predict_fitted
from stimrig.identify.estimation.still import moves
from stimrig.identify.estimation.uncertainty import covariance_of
from stimrig.identify.experiments import NOTHING, Experiment, plan, plan_further
from stimrig.identify.results import Diagnosis

MAX_PARAMETERS = 24
"""The wave of a tremor has hundreds."""
STATISTICS = (
    "fit_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "ceiling_percent", "held_out_ceiling_percent",
    "held_out_by", "repetition",
)  # fmt: skip


def diagnosis_of(search: EffectSearch) -> Diagnosis:
    """The `Diagnosis` that a search gives."""
    verdict = judge(search)
    base, final = search.steps[0].statistics, search.steps[-1].statistics
    missing, free = _effects(search, verdict)
    residual = search.record.torque_nm - predict_fitted(search.base)[0]
    counted = search.base.problem.setup.grid.counted
    remainder = search.remainder
    fields: dict[str, Any] = {
        "noise_sd_nm": search.raw.noise_sd_nm,
        "slow_noise": {
            "sd_nm": search.last.noise.sd_nm * float(np.sqrt(min(search.last.noise.share, 1.0))),
            "ar1": search.last.noise.ar1,
        },
        "base": {key: base[key] for key in STATISTICS},
        "verdict": verdict.kind,
        "probability": verdict.probability,
        "table": tuple(table_of(search, verdict, {row["effect"]: row["behaves_as"] for row in free})),
        "missing": tuple(missing),
        "free": tuple(free),
        "add": tuple(step.added for step in helpful(search)[0] if step.added),
        "where": tuple(worst_places(search.record, residual, search.raw.noise_sd_nm, rows=counted)),
        "with_all": {key: final[key] for key in STATISTICS} | {"noise_sd_nm": final["noise_sd_nm"]},
        "residual_check": _is_noise(search) if verdict.kind == "nothing_missing" else None,
        "explained": remainder.explained,
        "structure_left": remainder.ratio,
        "unseen": remainder.held_out and asdict(remainder.held_out),
        "candidates": tuple([_candidate(candidate) for candidate in tried] for tried in search.rounds),
        "notes": remainder.notes,
    }
    fields["deciding_experiment"] = _deciding(search, verdict, fields)
    return Diagnosis(**fields)


def _effects(search: EffectSearch, verdict: Verdict) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of `missing`, most probable first and of equal ones the first found, and of `free`."""
    fitted = search.last.written
    names = [name for name, _ in fitted.effects]
    covariance = covariance_of(fitted) if len(search.steps) > 1 else np.zeros((0, 0))
    missing, free = [], []
    for before, step in pairwise(search.steps):
        index = names.index(str(step.added))
        described, form = find_effect(names[index]), fitted.effects[index][1]
        row = {
            "effect": described.id,
            "name": described.name,
            "form": form.name,
            "equation": form.equation,
            "parameters": dict(list(describe_parameters(fitted, index, covariance).items())[:MAX_PARAMETERS]),
        }
        if (shape := shape_of(fitted, index, covariance)) is not None:
            axes = {"axis" if key == "effect" else key: value for key, value in shape.items()}
            free.append(row | {"left_out": difference(before.left_out, step.left_out).words_of_choice} | axes)
        else:
            missing.append(row | _named(search, verdict, before, step))
    missing.sort(key=lambda row: (row["effect"] not in search.names("detected"), -row["probability"]))
    return missing, free


def _named(search: EffectSearch, verdict: Verdict, before: Step, step: Step) -> dict[str, Any]:
    """What is said of an effect that is named, beside its form and its parameters."""
    described = find_effect(str(step.added))
    rivals = verdict.rivals.get(described.id, {})
    tried = {candidate.effect.id: candidate for candidate in step.tried}
    confused = sorted(
        (name for name in rivals if name and name != described.id and _is_rival(tried, rivals, described, name)),
        key=lambda name: -rivals[name],
    )
    chance, others = verdict.probabilities[described.id], max(1.0 - rivals.get(described.id, 0.0), 1e-9)
    chances = {name: (1.0 - chance) * share / others for name, share in rivals.items() if name}
    experiment = None
    if confused and not (described.band or find_effect(confused[0]).band):
        fits = {name: tried[name].fitted for name in (described.id, confused[0])}
        experiment = plan(search.record, fits)
    return {
        "part": described.part,
        "probability": chance,
        "rms_before_nm": before.statistics["rms_nm"],
        "rms_after_nm": step.statistics["rms_nm"],
        "held_out_rms_before_nm": before.statistics["held_out_rms_nm"],
        "held_out_rms_after_nm": step.statistics["held_out_rms_nm"],
        "confused_with": confused,
        "next_experiment": experiment.text if experiment else described.separated_by,
        "next_experiment_plan": experiment and _plan(experiment),
        "objection": verdict.objections.get(described.id),
        "rival_probabilities": {name: p for name, p in (chances | {described.id: chance}).items() if p >= 0.005},
        "plain": described.plain,
    }


def _is_rival(tried: Mapping[str, Candidate], rivals: Mapping[str, float], best: Effect, name: str) -> bool:
    """Return True if a record cannot separate an effect from the best one.

    One that resembles it and gains nearly as much is a rival, too: in another form it might be better.
    """
    similar = name in best.resembles or best.id in find_effect(name).resembles
    return rivals[name] >= LEAST_RIVAL or (similar and tried[name].gain > CLOSE * tried[best.id].gain)


def _plan(experiment: Experiment) -> dict[str, Any]:
    return {key: value for key, value in experiment.to_dict().items() if key != "rivals"}


def _deciding(search: EffectSearch, verdict: Verdict, diagnosis: dict[str, Any]) -> dict[str, Any] | None:
    """The test for what is left, or for an effect that the record neither names nor excludes."""
    if _undecided(search, verdict, any(row["next_experiment_plan"] for row in diagnosis["missing"])):
        return _plan(plan_further(search.record, search.last, search.steps[-1].rivals))
    best = search.rounds[0][0] if only_open(diagnosis) else None
    if best is None or best.effect.band or best.effect.sporadic:
        return None
    return _plan(plan(search.record, {best.effect.id: best.fitted, NOTHING: search.last}))


def _undecided(search: EffectSearch, verdict: Verdict, planned: bool) -> bool:
    """Return True if a further test is planned for the structure that is left.

    Beside effects that are named, where no test is `planned` for their rivals: if all could be foreseen and leave more
    than noise, or if something speaks against an effort, which does not come again with the pulses.
    None is planned for a moving joint, which has tests of its own, nor where the curve is a guess or the muscle hardly
    answers: the dose would be a guess, too.
    """
    named = verdict.kind == "effect_missing" and not planned
    if named and not any(find_effect(name).sporadic for name in verdict.objections):
        named = leaves_more(search) and all(find_effect(name).predictable for name in search.names("library"))
    if not named and verdict.kind != "unexplained_structure":
        return False
    still = search.record.angle_rad is None or not moves(search.last.problem.setup.grid, search.rows)
    return still and finish("maximum-likelihood", search.last).quality["gates"]["torque"]["passed"]


def _is_noise(search: EffectSearch) -> bool:
    """Return True if the residual of the examined model passes the model's own check for noise."""
    model = finish("maximum-likelihood", search.base, statistics=search.steps[0].statistics)
    return bool(model.quality["gates"]["residual"]["passed"])


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
