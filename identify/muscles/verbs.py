"""`fit`, `diagnose` and `improve` of several muscles at one joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.diagnosis.search import Progress, silent
from stimrig.identify.effects import find_effect
from stimrig.identify.errors import BadRequest, NotIdentifiable
from stimrig.identify.estimation.effect_fit import try_effect
from stimrig.identify.estimation.fit_statistics import fit_statistics
from stimrig.identify.muscles.finish import finished, held_out_errors, statistics_of
from stimrig.identify.muscles.interplay import registry
from stimrig.identify.muscles.joint_fit import JointFitted, fit_all, prepared
from stimrig.identify.muscles.model import JointModel, key_of, predict
from stimrig.identify.muscles.problem import Acting
from stimrig.identify.muscles.record import JointRecord
from stimrig.identify.muscles.results import JointDiagnosis, JointImprovement, conclude, name_of
from stimrig.identify.muscles.search import JointSearch, probability, rivals_of, search

COLUMNS = ("fit_percent", "rms_nm", "held_out_rms_nm", "held_out_fit_percent", "alone", "both")


def fit(
    record: JointRecord,
    effects: Mapping[str, Sequence[str]] | None = None,
    interplay: Sequence[str] = (),
    progress: Progress | None = None,
) -> JointModel:
    """Fit all muscles of a record together.

    Parameters
    ----------
    record : JointRecord
        Pulse widths of each channel, and the torque of the joint.
    effects : mapping, optional
        By channel, ids of effects of its muscle, or "id:form".
    interplay : sequence of str
        "co_contraction", "cross_talk:biceps>triceps"; a form may follow after a colon.
    progress : callable, optional
        Called with the share done, 0 to 1, and a line of text; it may raise `Cancelled`.

    Returns
    -------
    JointModel

    Raises
    ------
    BadRequest
        An unknown channel, effect or interplay.
    BadRecord, NotIdentifiable
        The record does not determine the model.
    """
    acting = [Acting.meant(text, record.names) for text in interplay]
    for name in effects or {}:
        if name not in record.names:
            raise BadRequest(f"no channel {name!r}", place="effects", fix=f"Use {', '.join(record.names)}.")
    say = progress or silent
    found = _solved(record, effects or {}, acting, say)
    say(0.9, "bands and tests of the residual")
    model = finished(found)
    say(1.0, "done")
    return model


def _solved(
    record: JointRecord, effects: Mapping[str, Sequence[str]], acting: Sequence[Sequence[Acting]], say: Progress
) -> JointFitted:
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            say(0.1, "fitting all muscles")
            found = fit_all(record)
            for number, forms in enumerate(acting):
                if forms[0].key(record.names) not in {one.key(record.names) for one in found.acting}:
                    found = found.with_likeliest(forms)
                say(0.4 + 0.2 * (number + 1) / len(acting), f"fitting {forms[0].interplay.name.lower()}")
            for name, wanted in effects.items():
                for text in wanted:
                    say(0.7, f"fitting {text} of {name}")
                    found = _with_named(found, record.names.index(name), text)
            return found
    except np.linalg.LinAlgError as error:
        fix = "Check that the torque follows the pulses of each channel."
        raise NotIdentifiable(f"no solution on this record ({error})", fix=fix) from error


def _with_named(found: JointFitted, place: int, text: str) -> JointFitted:
    """With an effect of one muscle. Raises NotIdentifiable: the record shows nothing that looks like it."""
    identifier, _, form = text.partition(":")
    effect, view = find_effect(identifier), found.views[place]
    if identifier in dict(found.effects[place]):
        return found
    tried = try_effect(effect, view, [effect.form(form)] if form else None, -np.inf)
    if tried is None or effect.band:
        name = found.record.names[place]
        raise NotIdentifiable(f"the record shows nothing of {name} that looks like {identifier}", fix="Leave it out.")
    return found.with_effect(place, identifier, tried.form, tried.fitted.parameters_of(identifier))


JOINT = "joint"
"""Whose an effect is that no muscle has by itself: it is kept with the first channel."""


def parted(effects: Sequence[str], names: Sequence[str]) -> tuple[dict[str, list[str]], list[str], list[str]]:
    """Of texts like "biceps.fatigue" and "co_contraction": by channel its effects; the interplay; what is neither."""
    own: dict[str, list[str]] = {}
    between, neither = [], []
    for text in effects:
        channel, _, effect = text.partition(".")
        if text.partition(":")[0] in registry():
            between.append(text)
        elif effect and channel in (*names, JOINT):
            own.setdefault(names[0] if channel == JOINT else channel, []).append(effect)
        else:
            neither.append(text)
    return own, between, neither


def structure_of(model: JointModel) -> tuple[dict[str, list[str]], list[str]]:
    """The effects and the interplay of a model, as `fit` takes them."""
    effects = {
        name: [f"{one['id']}:{one['form']}" for one in own.effects]
        for name, own in zip(model.names, model.models, strict=True)
    }
    return effects, [f"{key_of(one)}:{one['form']}" for one in model.interplay]


def searched(record: JointRecord, model: JointModel | None, progress: Progress | None) -> JointSearch:
    """One search, for both `diagnosis_of` and `improvement_of`. Raises as `diagnose`."""
    base = None
    if model is not None:
        effects, interplay = structure_of(model)
        acting = [Acting.meant(text, record.names) for text in interplay]
        base = _solved(record, effects, acting, silent)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return search(record, progress, base)
    except np.linalg.LinAlgError as error:
        raise NotIdentifiable(f"no solution on this record ({error})", fix="Check the channels.") from error


def diagnose(record: JointRecord, model: JointModel | None = None, progress: Progress | None = None) -> JointDiagnosis:
    """What a model of several muscles lacks; without a model, what the plain structure of the record lacks.

    Raises BadRequest, BadRecord, NotIdentifiable: as `fit`. Cancelled: `progress` asked to stop.

    Parameters
    ----------
    record : JointRecord
        The measurement.
    model : JointModel, optional
        None: the plain structure.
    progress : callable, optional
        Called with a share of 0 to 1 and a line of text; what it raises ends the work.

    Returns
    -------
    JointDiagnosis
    """
    return diagnosis_of(searched(record, model, progress))


def diagnosis_of(found: JointSearch) -> JointDiagnosis:
    """The diagnosis of a search."""
    missing = tuple(sorted(_missing(found), key=lambda row: -row["probability"]))
    verdict = "effect_missing" if missing else "unexplained_structure" if found.unexplained else "nothing_missing"
    first = finished(found.chain[0])
    return JointDiagnosis(
        noise_sd_nm=first.fit["noise_sd_nm"],
        base=first.fit,
        verdict=verdict,
        missing=missing,
        muscles=tuple({"name": name, "unexplained": name in found.unexplained} for name in found.last.record.names),
        candidates=_refused(found),
        model=first,
        conclusion=conclude(missing, found.unexplained),
        notes=found.last.record.records[0].notes,
    )


def _missing(found: JointSearch) -> list[dict[str, Any]]:
    rows, errors = [], [statistics_of(one) for one in found.chain]
    for one, (before, after) in zip(found.added, pairwise(errors), strict=True):
        told = registry().get(one.key.partition(":")[0])
        effect = told or find_effect(one.key.partition(".")[2])
        rows.append(
            {
                "effect": one.key,
                "name": name_of(one.key),
                "form": one.form,
                "probability": probability(found, one),
                "log_evidence_gain": one.gain,
                "rms_before_nm": before["rms_nm"],
                "rms_after_nm": after["rms_nm"],
                "held_out_rms_before_nm": before["held_out_rms_nm"],
                "held_out_rms_after_nm": after["held_out_rms_nm"],
                "confused_with": list(rivals_of(one.key) or effect.resembles),
                "next_experiment": effect.separated_by,
                "plain": effect.plain,
            }
        )
    return rows


def _refused(found: JointSearch) -> tuple[dict[str, Any], ...]:
    added = {one.key for one in found.added}
    return tuple(
        {"effect": key, "name": name_of(key), "log_evidence_gain": one.gain, "reason": one.reason}
        for key, one in found.refused.items()
        if key not in added
    )


def compare(model: JointModel, record: JointRecord) -> dict[str, Any]:
    """The model's error on a record, by segment, and on held-out pulses of each muscle alone and of both.

    Raises BadModel, BadRequest: as `predict`.

    Parameters
    ----------
    model : JointModel
        The model.
    record : JointRecord
        The measurement.

    Returns
    -------
    dict
    """
    return errors_of(record, predict(model, record))


def errors_of(record: JointRecord, predicted_nm: np.ndarray) -> dict[str, Any]:
    """The same of a prediction at the record's samples, N·m, shape (N,)."""
    record, grids, raw = prepared(record)
    told = fit_statistics(grids[0], grids[0].fitted, predicted_nm, raw.noise_sd_nm)
    notes = list(record.records[0].notes)
    return {"notes": notes} | told | held_out_errors(record, predicted_nm, grids[0].counted)


def improve(record: JointRecord, model: JointModel | None = None, progress: Progress | None = None) -> JointImprovement:
    """Fit models of several muscles, each with one thing more, while something is needed. Raises as `diagnose`.

    Parameters
    ----------
    record : JointRecord
        The measurement.
    model : JointModel, optional
        To begin with; None: the plain structure.
    progress : callable, optional
        Called with a share of 0 to 1 and a line of text; what it raises ends the work.

    Returns
    -------
    JointImprovement
    """
    return improvement_of(searched(record, model, progress))


def improvement_of(found: JointSearch) -> JointImprovement:
    """The improvement of a search."""
    steps, models, parent = [], [], ""
    for one, fitted in zip([None, *found.added], found.chain, strict=True):
        reason = (
            "The plain structure of all muscles." if one is None else f"It raises the log evidence by {one.gain:.1f}."
        )
        model = finished(fitted, [reason])
        model = model.with_(data=model.data | ({"parent": parent} if parent else {}))
        parent = model.model_id
        models.append(model)
        key = None if one is None else one.key
        name = "The plain structure" if one is None else name_of(one.key)
        told = {column: model.fit.get(column) for column in COLUMNS}
        steps.append({"added": key, "name": name, "model_id": model.model_id, "reason": reason} | told)
    verdict = "unexplained_structure" if found.unexplained else "effect_missing" if found.added else "nothing_missing"
    return JointImprovement(models[0].fit["noise_sd_nm"], verdict, tuple(steps), tuple(models), _refused(found))
