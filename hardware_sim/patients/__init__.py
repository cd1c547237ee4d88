"""Patients by name. A patient is one file with `Parameters`, a frozen dataclass of numbers, and a muscle made of them.

A file in TOML or JSON names one of them and overrides its parameters::

    patient = "paper"
    [parameters]
    damping_ratio = 0.8
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.errors import PatientError
from stimrig.hardware_sim.patients import calcium, changing, paper
from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.tables import read_table

PATIENTS: dict[str, tuple[type[Any], Callable[[Any], Muscle]]] = {
    "calcium": (calcium.Parameters, calcium.CalciumMuscle),
    "changing": (changing.Parameters, changing.ChangingMuscle),
    "paper": (paper.Parameters, paper.PaperMuscle),
}
"""Parameters and muscle, in alphabetical order."""
NAMES = tuple(PATIENTS)


def make(name: str, parameters: Mapping[str, float] | None = None) -> Muscle:
    """The named patient (one of `NAMES`) at rest, with some of its parameters overridden.

    Raises PatientError: there is no such patient, or it has no such parameter, or a value is not a finite number or out
    of range.
    """
    values = parameters or {}
    if name not in PATIENTS:
        raise PatientError(f"patient '{name}' is neither a file nor one of {', '.join(NAMES)}")
    kind, muscle = PATIENTS[name]
    known: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(kind)}
    for key, value in values.items():
        if key not in known:
            raise PatientError(f"patient '{name}' has no parameter '{key}'; it has {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise PatientError(f"parameter '{key}' must be a finite number, not {value!r}")
        if key.endswith(("_s", "_ma", "_us")) and known[key] > 0 and not value > 0:  # a shift may have either sign
            raise PatientError(f"parameter '{key}' must be above zero, not {value!r}")
    return muscle(kind(**values))


def from_file(path: Path) -> Muscle:
    """The patient that a TOML or JSON file describes.

    Raises PatientError: the file cannot be read, is malformed, or describes no patient; names the file.
    """
    described = read_table(path, PatientError, "a table with 'patient' and 'parameters'")
    unknown = sorted(set(described) - {"patient", "parameters"})
    if unknown:
        raise PatientError(f"{path}: unknown key '{unknown[0]}'; a patient's file has 'patient' and 'parameters'")
    parameters = described.get("parameters", {})
    if not isinstance(parameters, dict):
        raise PatientError(f"{path}: 'parameters' must be a table of names and numbers")
    try:
        return make(str(described.get("patient", "paper")), parameters)
    except PatientError as error:
        raise PatientError(f"{path}: {error}") from None
