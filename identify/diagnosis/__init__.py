"""What is missing from the model of a record: candidates, evidence, verdict, words."""

from __future__ import annotations

from identify.diagnosis.analysis import Analysis, analyse
from identify.diagnosis.candidates import Progress
from identify.diagnosis.report import report
from identify.diagnosis.verdict import Verdict, judge
from identify.dynamics.linear import SecondOrder
from identify.errors import BadRequest
from identify.model import Model
from identify.records.record import Record
from identify.results import Diagnosis


def diagnose(record: Record, model: Model | None = None, progress: Progress | None = None) -> Diagnosis:
    """What is missing from a Hammerstein model of this record.

    Parameters
    ----------
    record : Record
        Pulse widths and torque; rows of `validate` are never used to fit or to choose an effect; they may
        only speak against one.
    model : Model or None
        Whose structure is criticised: its effects in their forms, fitted to this record. The plain Hammerstein
        structure where none is given.
    progress : callable or None
        Called with a share of 0 to 1 and a line of text; may raise `Cancelled`.

    Returns
    -------
    Diagnosis
        The verdict, what is missing (most probable first), and the evidence for it.

    Raises
    ------
    BadRecord
        Too short, or sampled too slowly.
    BadRequest
        A model whose dynamics are not of the second order: effects do not stand on it.
    """
    work = analyse(record, progress, structure=structure_of(model))
    result = report(work, judge(work))
    if progress is not None:
        progress(1.0, "done")
    return result


def structure_of(model: Model | None) -> list[str]:
    """The effects of a model with their forms, as `analyse` takes them; none for the plain structure.

    Raises
    ------
    BadRequest
        The model's dynamics are not of the second order.
    """
    if model is None:
        return []
    if not isinstance(model.linear, SecondOrder):
        raise BadRequest(
            f"effects do not stand on a model of {model.method}",
            place="model",
            mend="Give one of maximum-likelihood or two-stage.",
        )
    return [f"{effect['id']}:{effect.get('form', '')}" for effect in model.effects]


__all__ = ["Analysis", "Verdict", "analyse", "diagnose", "judge", "structure_of"]
