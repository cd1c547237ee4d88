"""What a verb found on one record, as the columns of its row: those of `--json`, lists in long form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stimrig import identify
from stimrig.api.cohort.tasks import Task

FIGURES = (
    "fit_percent", "ceiling_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm", "held_out_by",
)  # fmt: skip
OF_EFFECT = ("probability", "rms_before_nm", "rms_after_nm", "held_out_rms_before_nm", "held_out_rms_after_nm")
OF_STEP = ("fit_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm")
MODEL = "model"
"""What a parameter belongs to where it is none of an effect's."""
Row = dict[str, Any]


def answer(record: Any, task: Task) -> Row:
    """Do the verb on a record.

    Raises
    ------
    IdentifyError
        The record does not allow it.
    """
    return VERBS[task.verb](record, task)


def _fit(record: Any, task: Task) -> Row:
    document = identify.fit(record, method=task.method, effects=task.effects).to_dict()
    fit, quality = document["fit"], document["quality"]
    return {
        **{name: fit.get(name) for name in FIGURES},
        "noise_sd_nm": fit.get("noise_sd_nm"),
        "verdict": quality["verdict"],
        "reasons": list(quality.get("reasons") or []),
        "effects": [_effect(effect) for effect in document["effects"]],
        "parameters": _of_model(document),
    }


def _diagnose(record: Any, _task: Task) -> Row:
    from stimrig.identify.diagnosis.experiment import planned

    found = identify.diagnose(record).to_dict()
    missing = found["missing"]
    plan = planned(missing)
    words = [row["next_experiment"] for row in missing if row["confused_with"]]
    return {
        **{name: found["base"].get(name) for name in FIGURES},
        "noise_sd_nm": found["noise_sd_nm"],
        "verdict": found["verdict"],
        "probability": found["probability"],
        "reasons": list(found["notes"]),
        "effects": [_effect(row) for row in missing],
        "parameters": [one for row in missing for one in _parameters(row["effect"], row["parameters"])],
        "next_experiment": plan.text if plan else next(iter(words), None),
        "next_experiment_s": plan.duration_s if plan else None,
    }  # fmt: skip


def _improve(record: Any, _task: Task) -> Row:
    improved = identify.improve(record)
    found = improved.to_dict()
    steps, document = found["steps"], improved.models[-1].to_dict()
    return {
        **{name: {**document["fit"], **steps[-1]}.get(name) for name in FIGURES},
        "noise_sd_nm": found["noise_sd_nm"],
        "verdict": found["verdict"],
        "reasons": [step["reason"] for step in steps[1:]],
        "effects": [_effect(effect) for effect in document["effects"]],
        "parameters": _of_model(document),
        "steps": [{name: step[name] for name in ("added", *OF_STEP)} for step in steps],
        "refused": [{name: row[name] for name in ("effect", "log_evidence_gain")} for row in found["refused"]],
    }  # fmt: skip


VERBS = {"fit": _fit, "diagnose": _diagnose, "improve": _improve}


def _effect(found: Mapping[str, Any]) -> Row:
    """An effect of a model, or one that a diagnosis found missing."""
    return {
        "effect": found.get("effect") or found["id"],
        "form": found.get("form"),
        **{name: found.get(name) for name in OF_EFFECT},
        "confused_with": list(found.get("confused_with") or []),
    }


def _of_model(document: Mapping[str, Any]) -> list[Row]:
    """Parameters of a MODEL.json: what a person reads off it, and those of its effects."""
    found = _parameters(MODEL, document.get("figures") or document["uncertainty"].get("figures") or {})
    for effect in document["effects"]:
        found += _parameters(effect["id"], effect["parameters"])
    return found


def _parameters(of: str, given: Mapping[str, Any]) -> list[Row]:
    rows = []
    for name, entry in given.items():
        if isinstance(entry.get("value"), int | float):  # a parameter in several values has no figure
            sd = entry.get("sd")
            sd = sd if isinstance(sd, int | float) else None
            rows.append({"of": of, "name": name, "value": entry["value"], "sd": sd, "unit": entry.get("unit") or "1"})
    return rows
