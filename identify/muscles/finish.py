"""From a joint fit to a model that can be kept: each muscle's own, the interplay, and the errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.fit_statistics import fit_statistics, rms, white_sd
from stimrig.identify.estimation.uncertainty import bands
from stimrig.identify.model import Model
from stimrig.identify.muscles.joint_fit import JointFitted, named_values
from stimrig.identify.muscles.model import KIND, JointModel, joint_fingerprint
from stimrig.identify.muscles.record import JointRecord

METHOD = "maximum-likelihood"
LEAST_SAMPLES = 8


def finished(found: JointFitted, reasons: Sequence[str] = ()) -> JointModel:
    """The model of a joint fit, with all that its file contains."""
    models = tuple(_muscle(found, place) for place in range(len(found.grids)))
    source = found.record.records[0].source
    statistics = statistics_of(found)
    whole = JointModel(
        channels=found.record.channels,
        models=models,
        interplay=tuple(_interplay(found)),
        fit=statistics,
        quality=_quality(found.record.names, models),
        valid_for={name: model.valid_for for name, model in zip(found.record.names, models, strict=True)},
        data={
            "name": source.name,
            "recording_id": source.recording_id,
            "sha256": source.sha256,
            "fingerprint": joint_fingerprint(found.measured),
            "notes": [*found.record.records[0].notes],
        },
        reasons=tuple(reasons),
    )
    return whole.named()


def _muscle(found: JointFitted, place: int) -> Model:
    """One muscle's model, its delay counted from its own pulses."""
    view, offset_s = found.views[place], found.record.channels[place].offset_s
    model, setup = finish(METHOD, view), view.problem.setup
    assert isinstance(model.linear, SecondOrder)
    covariance = model.covariance
    if covariance is not None:
        own = np.array([name == "delay_s" for name in covariance.names])
        covariance = replace(covariance, values=covariance.values - offset_s * own)
    settings = {"scale_nm": setup.scale_nm, "sign": setup.sign, "zero_nm": setup.zero_nm}
    settings |= {"noise_sd_nm": setup.noise_sd_nm, "reference_s": setup.reference_s}
    model = model.with_(
        linear=replace(model.linear, delay_s=model.linear.delay_s - offset_s),
        covariance=covariance,
        extra=model.extra | {KIND: settings},
    )
    return model.with_(bands=bands(model))


def _interplay(found: JointFitted) -> list[dict[str, Any]]:
    whole, names = found.fitted, found.record.names
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole.hessian), 1e-300))
    scaled = whole.hessian * scale[:, None] * scale[None, :]
    sd = scale * np.sqrt(np.maximum(np.diag(np.linalg.inv(scaled + 1e-12 * np.eye(scale.size))), 0.0))
    told = []
    for acting, values in zip(found.acting, named_values(found.problem, whole.theta, found.acting), strict=True):
        form = acting.interplay.form(acting.form)
        ends = {"from": names[acting.between[0]], "to": names[acting.between[1]]} if acting.between else {}
        parameters = {
            name: {"value": value, "sd": float(sd[place]), "unit": "1"} for name, (value, place) in values.items()
        }
        entry = {"id": acting.interplay.id, **ends, "form": form.name, "equation": form.equation}
        told.append(entry | {"parameters": parameters})
    return told


def statistics_of(found: JointFitted) -> dict[str, Any]:
    """Errors and best-fit % of the joint, and of each muscle alone and both on held-out pulses."""
    grid, fitted = found.grids[0], found.fitted
    predicted = found.predicted[0]
    noise = white_sd(grid, predicted, fitted.noise.sd_nm, fitted.freedom, fitted.noise.is_white)
    told = fit_statistics(grid, found.problem.setup.fitted, predicted, noise)
    told |= {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood}
    del told["repetition"]  # it goes by the pulses of one channel
    return told | held_out_errors(found.record, predicted, grid.counted)


def held_out_errors(record: JointRecord, predicted_nm: np.ndarray, counted: np.ndarray) -> dict[str, Any]:
    """The error on held-out pulses while one muscle moved alone, by channel, and while several did, N·m."""
    moving = record.moving()
    rows = record.held_out & counted
    several = np.sum(list(moving.values()), axis=0)
    error = record.torque_nm - predicted_nm

    def told(own: np.ndarray) -> dict[str, float | None]:
        enough = own.sum() >= LEAST_SAMPLES
        return {"held_out_rms_nm": rms(error[own]) if enough else None, "samples": int(own.sum())}

    alone = {name: told(rows & own & (several == 1)) for name, own in moving.items()}
    return {"alone": alone, "both": told(rows & (several > 1))}


def _quality(names: Sequence[str], models: Sequence[Model]) -> dict[str, Any]:
    """The worst of the muscles' verdicts, with all their checks."""
    order = ("usable", "usable with care", "not usable")
    named = list(zip(names, models, strict=True))
    whose, of = max(named, key=lambda one: order.index(one[1].quality["verdict"]))
    worst = of.quality
    gates = {f"{name}.{gate}": told for name, model in named for gate, told in model.quality["gates"].items()}
    reasons = list(dict.fromkeys(f"{name}: {reason}" for name, model in named for reason in model.quality["reasons"]))
    return {"verdict": worst["verdict"], "words": f"{whose}: {worst['words']}", "reasons": reasons, "gates": gates}
