"""Diagnosis of a model: the search for effects it lacks, the verdict, and the result in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stimrig.identify.diagnosis.free import search_record
from stimrig.identify.diagnosis.result import diagnosis_of
from stimrig.identify.diagnosis.search import EffectSearch, Progress
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.effects import find_effect
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.effect_fit import fitted_with
from stimrig.identify.experiments import NOTHING, Experiment, plan
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import same_data
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis


def diagnose(record: Record, model: Model | None = None, progress: Progress | None = None) -> Diagnosis:
    """Say which effects a Hammerstein model of this record lacks.

    Parameters
    ----------
    record : Record
        Pulse widths and torque. Rows of `validate` are never used to fit or to choose an effect; they can only speak
        against one.
    model : Model or None
        Its structure (its effects in their forms) is fitted to this record and examined. Without a model, the plain
        Hammerstein structure is examined.
    progress : callable or None
        Called with the share done, 0 to 1, and a line of text. It may raise `Cancelled`.

    Returns
    -------
    Diagnosis
        The verdict, what is missing (most probable first), and the evidence for it.

    Raises
    ------
    BadRecord
        Too short, or sampled too slowly.
    BadRequest
        The model's dynamics are not of second order: effects cannot be added to it.
    NotIdentifiable
        Less than three seconds may be fitted, or the record does not determine the model.
    """
    result = diagnosis_of(search_for(record, model, progress))
    if progress is not None:
        progress(1.0, "done")
    return result


def search_for(record: Record, model: Model | None = None, progress: Progress | None = None) -> EffectSearch:
    """Search for what a model lacks on a record.

    The model of a step of an earlier search of the same record is not searched again as such: that search is run, and
    what the model lacks are the later steps. Errors are those of `diagnose`.

    Parameters
    ----------
    record : Record
        The measurement.
    model : Model, optional
        Its structure is examined; default: the plain one.
    progress : callable, optional
        Called with a share of 0 to 1 and a line of text; what it raises ends the work.
    """
    structure = structure_of(model)
    begun_with = None if model is None else model.extra.get("begun_with")
    if model is not None and begun_with is not None and {*begun_with} <= {*structure} and same_data(model, record):
        begun_with = list(dict.fromkeys(begun_with))
        search = search_record(record, progress, begun_with)
        number = len(structure) - len(begun_with)  # each step adds one effect
        if number < len(search.steps) and search.steps[number].structure == structure:
            return search.from_step(number)
    return search_record(record, progress, structure)


def structure_of(model: Model | None) -> list[str]:
    """The effects of a model as `search_effects` takes them ("id:form"); an empty list for the plain structure.

    Raises BadRequest: the model's dynamics are not of second order.

    Parameters
    ----------
    model : Model, optional
        None: the plain structure.
    """
    if model is None:
        return []
    if not isinstance(model.linear, SecondOrder):
        fix = "Give a model of maximum-likelihood or two-stage."
        raise BadRequest(f"effects cannot be added to a model of {model.method}", place="model", fix=fix)
    return [f"{effect['id']}:{effect.get('form', '')}" for effect in model.effects]


def next_experiment(about: Record | Diagnosis, rivals: Sequence[str] = ()) -> Experiment | None:
    """The shortest safe test that tells rival effects apart.

    Parameters
    ----------
    about : Record or Diagnosis
        A record on which the rivals cannot be told apart, or what `diagnose` found on one.
    rivals : sequence of str
        Ids of effects to tell apart on a record; one alone is told apart from no effect. Without any, the record is
        diagnosed first: its most probable effect that has rivals, and the first of these.

    Returns
    -------
    Experiment or None
        None if no test can be planned from this record.

    Raises
    ------
    BadRequest
        An effect is not in the library.
    """
    if not rivals:
        diagnosis = about if isinstance(about, Diagnosis) else diagnose(about)
        return planned(diagnosis.missing, diagnosis.deciding_experiment)
    if isinstance(about, Diagnosis):
        raise TypeError("rivals are told apart on a record: next_experiment(record, rivals)")
    names = list(dict.fromkeys(rivals))
    for name in names:
        find_effect(name)  # an unknown one is refused before anything is fitted
    fits = {name: fitted_with(about, [name]) for name in names}
    if len(names) == 1:
        fits[NOTHING] = fitted_with(about, [])
    return plan(about, fits)


def planned(missing: Sequence[Mapping[str, Any]], further: Mapping[str, Any] | None = None) -> Experiment | None:
    """The `further` experiment, for what is left; else that of the first missing effect with rivals; or None.

    Parameters
    ----------
    missing : Sequence[mapping]
        As `Diagnosis.missing`.
    further : mapping, optional
        What would teach most about what is left.
    """
    if further:
        return Experiment(rivals=(), **further)
    for row in missing:
        if row["confused_with"] and row["next_experiment_plan"]:
            return Experiment(rivals=(row["effect"], row["confused_with"][0]), **row["next_experiment_plan"])
    return None
