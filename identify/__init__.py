"""Identification of electrically stimulated muscle, and diagnosis of the models. Pure: arrays in, model out.

Names are loaded when they are first used, so that `import identify` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stimrig.identify.criticism import compare
    from stimrig.identify.diagnosis import diagnose, next_experiment
    from stimrig.identify.diagnosis.carrying import carry
    from stimrig.identify.diagnosis.improvement import diagnose_and_improve, explain, improve
    from stimrig.identify.errors import BadModel, BadRecord, BadRequest, Cancelled, IdentifyError, NotIdentifiable
    from stimrig.identify.experiments import Experiment
    from stimrig.identify.fitting import fit
    from stimrig.identify.model import Model
    from stimrig.identify.problem.predict import predict
    from stimrig.identify.records import read
    from stimrig.identify.records.record import Record
    from stimrig.identify.results import Carried, Comparison, Diagnosis, Explanation, Improvement

__all__ = [
    "BadModel", "BadRecord", "BadRequest", "Cancelled", "Carried", "Comparison", "Diagnosis", "Experiment",
    "Explanation", "IdentifyError", "Improvement", "Model", "NotIdentifiable", "Record", "carry", "compare", "diagnose",
    "diagnose_and_improve", "explain", "fit", "improve", "next_experiment", "predict", "read",
]  # fmt: skip
_PLACES = {
    "criticism": ("compare",),
    "diagnosis": ("diagnose", "next_experiment"),
    "diagnosis.carrying": ("carry",),
    "diagnosis.improvement": ("diagnose_and_improve", "explain", "improve"),
    "errors": ("BadModel", "BadRecord", "BadRequest", "Cancelled", "IdentifyError", "NotIdentifiable"),
    "experiments": ("Experiment",),
    "fitting": ("fit",),
    "model": ("Model",),
    "records": ("read",),
    "records.record": ("Record",),
    "results": ("Carried", "Comparison", "Diagnosis", "Explanation", "Improvement"),
    "problem.predict": ("predict",),
}


def __getattr__(name: str) -> Any:
    if name in ("effects", "methods"):
        return import_module(f"stimrig.identify.{name}")
    for place, names in _PLACES.items():
        if name in names:
            return getattr(import_module(f"stimrig.identify.{place}"), name)
    raise AttributeError(f"module 'stimrig.identify' has no attribute {name!r}")
