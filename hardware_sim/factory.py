"""Devices as a command line or a scenario describes them: with a patient and an arm by name, file or seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stimrig.hardware_sim import hidden, patients
from stimrig.hardware_sim.arm import description as arms
from stimrig.hardware_sim.arm.description import Arm
from stimrig.hardware_sim.arm.tissue import bare
from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.settings import Settings

DESIGN = "design"
HIDDEN = "hidden:"


def make_devices(
    settings: Settings, arm: str | None = None, arm_laws: Sequence[str] = (), epoch_us: int = 0
) -> Devices:
    """The devices of these settings, at emulated time 0, with their muscle at rest.

    The patient is a name, the path of a file, or `hidden:SEED`. `arm`: as `--arm` takes it, a mode with settings; for a
    hidden patient also `design`; None: the joint is held still and has no sensor. `arm_laws`: as `--arm-law` takes
    them. `epoch_us`: what the sensors' clocks show at time 0, µs.

    Raises HardwareSimError: patient, arm or a setting cannot be used.
    """
    seed = _hidden_seed(settings.patient)
    if seed is not None and seed < 0:
        raise HardwareSimError(f"patient '{settings.patient}': give a seed of 0 or above")
    muscle = _muscle(settings.patient) if seed is None else hidden.make(seed, moving=arm is not None)
    return Devices(muscle, settings, None if arm is None else _arm(arm, arm_laws, seed), epoch_us)


LONGEST_NAME = 256
"""Longest name of a file; the system refuses to look for far longer ones."""


def _hidden_seed(patient: str) -> int | None:
    try:
        return int(patient.removeprefix(HIDDEN)) if patient.startswith(HIDDEN) else None
    except ValueError:
        return None


def _muscle(patient: str) -> Muscle:
    file = Path(patient)
    is_file = file.suffix.lower() == ".toml" or (len(patient) < LONGEST_NAME and file.is_file())
    return patients.from_file(file) if is_file and patient not in patients.PATIENTS else patients.make(patient)


def _arm(text: str, laws: Sequence[str], hidden_seed: int | None) -> Arm:
    """The arm asked for; a hidden patient brings all that its joint does, and how it moves if asked for by `design`."""
    if hidden_seed is None:
        return arms.set_laws(arms.read(text), laws)
    if laws:
        raise HardwareSimError("--arm-law: what the arm of a hidden patient does is hidden, too")
    if text == DESIGN:
        return Arm("waves", hidden.movement(hidden_seed), bare())
    return replace(arms.read(text), tissue=bare())
