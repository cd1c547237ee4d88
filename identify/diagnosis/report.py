"""A verdict in the contract's words, and in a clinician's."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.criticism.where import worst_places
from identify.diagnosis.analysis import Analysis
from identify.diagnosis.steps import Step, steps
from identify.diagnosis.thresholds import CLOSE, RIVAL
from identify.diagnosis.verdict import Verdict
from identify.effects import get
from identify.estimation.adding import names
from identify.estimation.finish import describe_parameters
from identify.estimation.tremor import predict_fitted, with_band
from identify.experiments import plan
from identify.results import Diagnosis

FIGURES = (
    "fit_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "ceiling_percent", "held_out_ceiling_percent",
    "held_out_by",
)  # fmt: skip


def report(work: Analysis, verdict: Verdict) -> Diagnosis:
    """The contract's keys, and more."""
    record, raw = work.record, work.raw
    base_prediction = predict_fitted(work.base)
    row = steps(work)
    base = row[0].figures
    missing = [_missing(work, verdict, effect, row) for effect in _ranked(work, verdict)]
    final = row[-1].figures
    residual = record.torque_nm - (
        predict_fitted(work.last) if verdict.kind == "unexplained_structure" else base_prediction
    )
    where = worst_places(
        record, residual, raw.noise_sd_nm, rows=~record.held_out & work.base.problem.setup.grid.counted
    )
    return Diagnosis(
        noise_sd_nm=raw.noise_sd_nm,
        slow_noise={
            "sd_nm": work.last.noise.sd_nm * float(np.sqrt(min(work.last.noise.share, 1.0))),
            "ar1": work.last.noise.ar1,
        },
        base={key: base[key] for key in FIGURES},
        verdict=verdict.kind,
        probability=verdict.probability,
        missing=tuple(missing),
        where=tuple(where),
        with_all={key: final[key] for key in FIGURES} | {"noise_sd_nm": final["noise_sd_nm"]},
        explained=verdict.explained,
        structure_left=verdict.structure,
        unseen=None
        if verdict.unseen is None
        else {"rms_nm": verdict.unseen.rms_nm, "allowed_nm": verdict.unseen.allowed_nm},
        candidates=tuple(_candidates(work)),
        notes=tuple(verdict.notes),
        plain=tuple(_plain(work, verdict, base, final, missing, where)),
    )


def _ranked(work: Analysis, verdict: Verdict) -> list[str]:
    """What the samples show beyond doubt, then by what would be lost without each."""
    return sorted(verdict.found, key=lambda e: (e not in work.given, -work.losses.get(e, 0.0), -verdict.found[e]))


def _missing(work: Analysis, verdict: Verdict, effect: str, row: list[Step]) -> dict[str, Any]:
    number = next(i for i, step in enumerate(row) if step.added == effect)
    before, after = row[number - 1].figures, row[number].figures
    fitted = with_band(work.last)
    index = [e for e, _ in fitted.effects].index(effect)
    rivals = verdict.rivals.get(effect, {})
    named = _close(work, effect)
    ranked = sorted((name for name in rivals if name and name != effect), key=lambda name: -rivals[name])
    confused = [name for name in ranked if rivals[name] >= RIVAL or name in named]
    described = get(effect)
    experiment = _experiment(work, effect, confused)
    return {
        "effect": effect,
        "name": described.name,
        "probability": verdict.found[effect],
        "rms_before_nm": before["rms_nm"],
        "rms_after_nm": after["rms_nm"],
        "held_out_rms_before_nm": before["held_out_rms_nm"],
        "held_out_rms_after_nm": after["held_out_rms_nm"],
        "confused_with": confused,
        "next_experiment": experiment["text"] if experiment else described.separated_by,
        "next_experiment_plan": experiment,
        "form": fitted.effects[index][1].name,
        "equation": fitted.effects[index][1].equation,
        "parameters": _few(describe_parameters(fitted, index)),
        "rival_probabilities": {name: p for name, p in rivals.items() if name and p >= 0.005},
        "plain": described.plain,
    }


def _close(work: Analysis, effect: str) -> set[str]:
    """Effects that the library calls alike, and that explain nearly as much: another form might turn the tables."""
    if effect not in work.added:
        return set()
    round_ = work.rounds[work.added.index(effect)]
    gains = {c.effect.id: c.gain for c in round_}
    alike = {c.effect.id for c in round_ if effect in c.effect.resembles} | set(get(effect).resembles)
    return {name for name in alike if gains.get(name, 0.0) > CLOSE * gains.get(effect, 0.0)}


def _experiment(work: Analysis, effect: str, confused: list[str]) -> dict[str, Any] | None:
    """The shortest test that tells an effect from its first rival, both as fitted in the same round."""
    if not confused or effect not in work.added:
        return None
    found = {c.effect.id: c.fitted for c in work.rounds[work.added.index(effect)]}
    rivals = {name: found[name] for name in (effect, confused[0]) if name in found and not get(name).band}
    if len(rivals) < 2:
        return None
    best = plan(work.record, rivals)
    return {key: best[key] for key in ("segments", "duration_s", "dose", "expected_log_evidence", "decides", "text")}


def _few(parameters: dict[str, Any]) -> dict[str, Any]:
    """The first two dozen: a tremor's wave has hundreds."""
    return dict(list(parameters.items())[:24])


def _candidates(work: Analysis) -> list[list[dict[str, Any]]]:
    return [
        [
            {
                "effect": c.effect.id,
                "form": c.form.name,
                "log_evidence_gain": c.gain,
                "rms_nm": c.fitted.rms_nm,
                "forms": c.forms,
            }
            for c in found
        ]
        for found in work.rounds
    ]


def _plain(
    work: Analysis, verdict: Verdict, base: dict[str, Any], final: dict[str, Any], missing: list, where: list
) -> list[str]:
    noise = work.raw.noise_sd_nm
    held = " and ".join(get(name).name.lower() for name in names(work.base))
    lines = [
        f"The model {f'with {held}' if held else 'without effects'} fits {base['fit_percent']:.1f} % where noise of "
        f"{noise:.3g} N·m allows {base['ceiling_percent']:.1f} %; on rows not fitted it errs by "
        f"{base['held_out_rms_nm']:.3g} N·m."
    ]
    if verdict.kind == "nothing_missing":
        lines.append("Nothing is missing: what is left looks like noise, at work and at rest alike.")
    if verdict.kind == "unexplained_structure":
        lines.append(
            "There is structure left that no effect of the library explains: the error goes with the muscle's work, "
            "and isn't noise of the measurement."
        )
        if where:
            lines.append(f"It sits mostly here: {where[0]['text']}.")
    for entry in missing:
        sure = (
            "very probably" if entry["probability"] > 0.9 else "probably" if entry["probability"] > 0.6 else "possibly"
        )
        text = f"{entry['name']} is {sure} missing ({100 * entry['probability']:.0f} %). {entry['plain']}"
        if entry["confused_with"]:
            others = ", ".join(get(name).name.lower() for name in entry["confused_with"])
            text += f" This record can't quite tell it from: {others}. To decide: {entry['next_experiment']}"
        lines.append(text)
    if missing and verdict.kind == "effect_missing":
        lines.append(
            f"With {'it' if len(missing) == 1 else 'them'} the error falls from {base['held_out_rms_nm']:.3g} to "
            f"{final['held_out_rms_nm']:.3g} N·m on rows not fitted."
        )
    return lines + verdict.notes
