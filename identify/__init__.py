"""Identification of electrically stimulated muscle, and diagnosis of the models. Pure: arrays in, model out.

Names are loaded when they are first used, so that `import identify` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from identify.criticism import compare
    from identify.diagnosis import diagnose
    from identify.diagnosis.carrying import carry
    from identify.diagnosis.experiment import Experiment, next_experiment
    from identify.diagnosis.improvement import improve
    from identify.errors import (
        BadModel,
        BadRecord,
        BadRequest,
        Cancelled,
        IdentifyError,
        NotIdentifiable,
    )
    from identify.fitting import fit
    from identify.model import Model
    from identify.records.read import read
    from identify.records.record import Record
    from identify.results import Carried, Comparison, Diagnosis, Improvement
    from identify.simulation.predict import predict

_PLACES = {
    name: f"identify.{module}"
    for module, names in {
        "criticism": ("compare",),
        "diagnosis": ("diagnose",),
        "diagnosis.carrying": ("carry",),
        "diagnosis.experiment": ("Experiment", "next_experiment"),
        "diagnosis.improvement": ("improve",),
        "errors": ("BadModel", "BadRecord", "BadRequest", "Cancelled", "IdentifyError", "NotIdentifiable"),
        "fitting": ("fit",),
        "model": ("Model",),
        "records.read": ("read",),
        "records.record": ("Record",),
        "results": ("Carried", "Comparison", "Diagnosis", "Improvement"),
        "simulation.predict": ("predict",),
    }.items()
    for name in names
}
_MODULES = {"effects", "methods"}

__all__ = [
    "BadModel",
    "BadRecord",
    "BadRequest",
    "Cancelled",
    "Carried",
    "Comparison",
    "Diagnosis",
    "Experiment",
    "IdentifyError",
    "Improvement",
    "Model",
    "NotIdentifiable",
    "Record",
    "carry",
    "compare",
    "diagnose",
    "fit",
    "improve",
    "next_experiment",
    "predict",
    "read",
]


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    if name in _MODULES:
        return import_module(f"identify.{name}")
    raise AttributeError(f"module 'identify' has no attribute {name!r}")
