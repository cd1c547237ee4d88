"""Several muscles at one joint, from one test: identified together, criticised, inverted for a controller.

Names are loaded when they are first used, as those of `identify`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stimrig.identify.muscles.inversion import JointInversion as JointInversion
    from stimrig.identify.muscles.inversion import Limits as Limits
    from stimrig.identify.muscles.inversion import invert as invert
    from stimrig.identify.muscles.model import JointModel as JointModel
    from stimrig.identify.muscles.model import is_joint_model as is_joint_model
    from stimrig.identify.muscles.model import parts as parts
    from stimrig.identify.muscles.model import predict as predict
    from stimrig.identify.muscles.model import whole_and_parts as whole_and_parts
    from stimrig.identify.muscles.record import Channel as Channel
    from stimrig.identify.muscles.record import JointRecord as JointRecord
    from stimrig.identify.muscles.record import held_later as held_later
    from stimrig.identify.muscles.record import is_joint as is_joint
    from stimrig.identify.muscles.record import read as read
    from stimrig.identify.muscles.results import JointDiagnosis as JointDiagnosis
    from stimrig.identify.muscles.results import JointImprovement as JointImprovement
    from stimrig.identify.muscles.verbs import compare as compare
    from stimrig.identify.muscles.verbs import diagnose as diagnose
    from stimrig.identify.muscles.verbs import fit as fit
    from stimrig.identify.muscles.verbs import improve as improve

_PLACES = {
    name: f"{__name__}.{module}"
    for module, names in {
        "inversion": ("JointInversion", "Limits", "invert"),
        "model": ("JointModel", "is_joint_model", "parts", "predict", "whole_and_parts"),
        "record": ("Channel", "JointRecord", "held_later", "is_joint", "read"),
        "results": ("JointDiagnosis", "JointImprovement"),
        "verbs": ("compare", "diagnose", "fit", "improve"),
    }.items()
    for name in names
}

__all__ = [*_PLACES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
