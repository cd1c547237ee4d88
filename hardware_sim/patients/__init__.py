"""Patients by name. A patient is one file with `Parameters`, a frozen dataclass of numbers, and a muscle made of them.

A file in TOML or JSON names one of them and overrides its parameters::

    patient = "paper"
    [parameters]
    damping_ratio = 0.8

Muscles of other physics are patients, too: those of `hidden`, their draws as parameters, or drawn by a set and a seed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
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
OTHER_PHYSICS = (
    *("ding", "ding_fatigue", "hill_series", "two_populations"),
    *("huxley", "unit_pool", "slack_tendon", "two_buffers", "cooperative", "sarcomere_chain", "closed_space"),
    *("central_plateau", "moving_electrode", "dry_cushion", "worn_reflex", "axon_pump", "swinging_splint"),
)
"""The names in `hidden.other_physics.OPEN`; importing that compiles, which takes a while."""
NAMES = (*PATIENTS, *OTHER_PHYSICS)
LONGEST_SEED = 18


def make(name: str, parameters: Mapping[str, float] | None = None) -> Muscle:
    """The named patient at rest, with some of its parameters overridden.

    Parameters
    ----------
    name
        One of `NAMES`, or `SET:SEED`: the muscle of that record of other physics, which has no parameters.
    parameters
        Numbers by name. Those of other physics stay within the bounds they are drawn from.

    Raises
    ------
    PatientError
        There is no such patient, or it has no such parameter, or a value is not a finite number or out of range.
    """
    given = parameters or {}
    if name in OTHER_PHYSICS:
        return _of_other_physics(name, given)
    if name not in PATIENTS:
        return _drawn(name, given)
    kind, muscle = PATIENTS[name]
    known: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(kind)}
    _check_numbers(name, given, known)
    for key, value in given.items():
        if key.endswith(("_s", "_ma", "_us")) and known[key] > 0 and not value > 0:  # a shift may have either sign
            raise PatientError(f"parameter '{key}' must be above zero, not {value!r}")
    return muscle(kind(**given))


def _check_numbers(name: str, given: Mapping[str, Any], known: Iterable[str]) -> None:
    for key, value in given.items():
        if key not in known:
            raise PatientError(f"patient '{name}' has no parameter '{key}'; it has {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise PatientError(f"parameter '{key}' must be a finite number, not {value!r}")


def _of_other_physics(name: str, given: Mapping[str, float]) -> Muscle:
    from stimrig.hardware_sim.hidden import live, other_physics

    known = other_physics.parameters(name)
    _check_numbers(name, given, known)
    for key, value in given.items():
        low, high, _ = known[key]
        if not low <= value <= high:
            raise PatientError(f"parameter '{key}' must be from {low:g} to {high:g}, not {value!r}")
    return live.HiddenMuscle(other_physics.make_muscle(name, given))


def _drawn(name: str, given: Mapping[str, float]) -> Muscle:
    """The muscle that `SET:SEED` names."""
    kinds, _, seed = name.partition(":")
    if seed.isascii() and seed.isdigit() and len(seed) < LONGEST_SEED:
        from stimrig.hardware_sim.hidden import live, other_physics

        if kinds in other_physics.SETS:
            if given:
                raise PatientError(f"patient '{name}' has no parameters; its seed decides them")
            return live.HiddenMuscle(other_physics.draw_muscle(kinds, int(seed)))
        raise PatientError(f"no set '{kinds}' of muscles; one of {', '.join(other_physics.SETS)}")
    raise PatientError(f"patient '{name}' is neither a file nor SET:SEED nor one of {', '.join(NAMES)}")


def from_file(path: Path) -> Muscle:
    """The patient that a TOML or JSON file describes.

    Raises
    ------
    PatientError
        The file cannot be read, is malformed, or describes no patient; names the file.
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
