"""Patients by name. A patient is one file with `Parameters`, a frozen dataclass of numbers, and a muscle made of them.

A TOML file names one of them and overrides its parameters::

    patient = "paper"
    [parameters]
    damping_ratio = 0.8
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients import changing, paper
from stimrig.hardware_sim.patients.muscle import Muscle

PATIENTS: dict[str, tuple[type[Any], Callable[[Any], Muscle]]] = {
    "changing": (changing.Parameters, changing.ChangingMuscle),
    "paper": (paper.Parameters, paper.PaperMuscle),
}
"""Parameters and muscle, in alphabetical order."""


def make(name: str, parameters: Mapping[str, float] | None = None) -> Muscle:
    """The named patient (one of `PATIENTS`) at rest, with some of its parameters overridden.

    Raises HardwareSimError: there is no such patient or parameter, or a value is not a finite number or out of range.
    """
    values = parameters or {}
    if name not in PATIENTS:
        raise HardwareSimError(f"patient '{name}' is neither a file nor one of {', '.join(PATIENTS)}")
    kind, muscle = PATIENTS[name]
    known: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(kind)}
    for key, value in values.items():
        if key not in known:
            raise HardwareSimError(f"patient '{name}' has no parameter '{key}'; it has {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise HardwareSimError(f"parameter '{key}' must be a finite number, not {value!r}")
        if key.endswith(("_s", "_ma", "_us")) and known[key] > 0 and not value > 0:  # a shift may have either sign
            raise HardwareSimError(f"parameter '{key}' must be above zero, not {value!r}")
    return muscle(kind(**values))


def from_file(path: Path) -> Muscle:
    """The patient that a TOML file describes.

    Raises HardwareSimError: the file cannot be read, is malformed, or describes no patient; names the file.
    """
    try:
        described = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as reason:
        raise HardwareSimError(f"{path}: cannot be read ({reason}); give a readable TOML file") from None
    except (ValueError, RecursionError) as reason:  # the decoder's ValueError names line and column
        raise HardwareSimError(f"{path}: not valid TOML: {reason}") from None
    name, parameters = described.pop("patient", "paper"), described.pop("parameters", {})
    if described:
        raise HardwareSimError(
            f"{path}: unknown key '{min(described)}'; a patient's file has 'patient' and 'parameters'"
        )
    if not isinstance(parameters, dict):
        raise HardwareSimError(f"{path}: 'parameters' must be a table of names and numbers")
    try:
        return make(str(name), parameters)
    except HardwareSimError as error:
        raise HardwareSimError(f"{path}: {error}") from None
