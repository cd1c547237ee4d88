"""Devices as a command line or a scenario describes them: with a patient and an arm by name, file or seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stimrig.hardware_sim import hidden, patients
from stimrig.hardware_sim.arm.limb import Arm, read_arm, set_laws
from stimrig.hardware_sim.arm.tissue import bare
from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.settings import Settings

DESIGN = "design"
LONGEST_NAME = 256  # of a file; the system refuses to look for far longer ones
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
    patient, file, seed = settings.patient, Path(settings.patient), None
    if patient.startswith(HIDDEN):
        digits = patient.removeprefix(HIDDEN)
        if not digits.isdecimal():
            raise HardwareSimError(f"patient '{patient}': give a seed of 0 or above")
        seed = int(digits)
        muscle: Muscle = hidden.make(seed, moving=arm is not None)
    elif file.suffix.lower() == ".toml" or (len(patient) < LONGEST_NAME and file.is_file()):
        muscle = patients.from_file(file)
    else:
        muscle = patients.make(patient)
    return Devices(muscle, settings, None if arm is None else _arm(arm, arm_laws, seed), epoch_us)


def _arm(text: str, laws: Sequence[str], hidden_seed: int | None) -> Arm:
    """The arm asked for; a hidden patient brings all that its joint does, and how it moves if asked for by `design`."""
    if hidden_seed is None:
        return set_laws(read_arm(text), laws)
    if laws:
        raise HardwareSimError("--arm-law: what the arm of a hidden patient does is hidden, too")
    if text == DESIGN:
        return Arm("waves", hidden.movement(hidden_seed), bare())
    return replace(read_arm(text), tissue=bare())
