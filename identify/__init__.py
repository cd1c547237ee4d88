"""Identification of electrically stimulated muscle, and diagnosis of the models. Pure: arrays in, model out.

Names are loaded when they are first used, so that `import identify` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stimrig.identify.criticism import compare as compare
    from stimrig.identify.diagnosis import diagnose as diagnose
    from stimrig.identify.diagnosis import next_experiment as next_experiment
    from stimrig.identify.diagnosis.carrying import carry as carry
    from stimrig.identify.diagnosis.improvement import diagnose_and_improve as diagnose_and_improve
    from stimrig.identify.diagnosis.improvement import explain as explain
    from stimrig.identify.diagnosis.improvement import improve as improve
    from stimrig.identify.errors import BadModel as BadModel
    from stimrig.identify.errors import BadRecord as BadRecord
    from stimrig.identify.errors import BadRequest as BadRequest
    from stimrig.identify.errors import Cancelled as Cancelled
    from stimrig.identify.errors import IdentifyError as IdentifyError
    from stimrig.identify.errors import NotIdentifiable as NotIdentifiable
    from stimrig.identify.experiments import Experiment as Experiment
    from stimrig.identify.fitting import fit as fit
    from stimrig.identify.model import Model as Model
    from stimrig.identify.records import read as read
    from stimrig.identify.records.record import Record as Record
    from stimrig.identify.results import Carried as Carried
    from stimrig.identify.results import Comparison as Comparison
    from stimrig.identify.results import Diagnosis as Diagnosis
    from stimrig.identify.results import Explanation as Explanation
    from stimrig.identify.results import Improvement as Improvement
    from stimrig.identify.simulation.predict import predict as predict

_PLACES = {
    name: f"stimrig.identify.{module}"
    for module, names in {
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
        "simulation.predict": ("predict",),
    }.items()
    for name in names
}
_MODULES = {"effects", "methods"}

__all__ = [*_PLACES]  # type: ignore


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    if name in _MODULES:
        return import_module(f"stimrig.identify.{name}")
    raise AttributeError(f"module 'stimrig.identify' has no attribute {name!r}")
