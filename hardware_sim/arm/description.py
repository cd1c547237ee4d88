"""An arm as the command line or a file describes it.

`--arm MODE[,SETTING=NUMBER…]`, or a TOML or JSON file::

    mode = "robot"
    [movement]            # the mode's settings
    from_deg = 30
    to_deg = 120
    deg_s = 20
    [mechanics]           # what `Mechanics` says of the forearm
    weight_nm = 2.8
    [passive]             # the law of each place, and its parameters
    law = "linear_friction"
    dry_nm = 0.3
    [torque_angle]
    law = "moment_arm"
    [torque_velocity]
    law = "none"
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stimrig.hardware_sim.arm.laws import LAWS
from stimrig.hardware_sim.arm.motion import LARGEST_DEG, SMALLEST_DEG, within
from stimrig.hardware_sim.arm.movers import MOVERS
from stimrig.hardware_sim.arm.tissue import DEFAULT_LAWS, Mechanics, Tissue, build, law
from stimrig.hardware_sim.errors import ArmError
from stimrig.hardware_sim.tables import read_table

KEYS = ("mode", "movement", "mechanics", *LAWS)


@dataclass(frozen=True)
class Arm:
    """Description of an arm: its first mover with settings, and its tissue."""

    mode: str = "held"
    movement: Mapping[str, Any] = field(default_factory=dict)
    tissue: Tissue = field(default_factory=Tissue)

    @property
    def start_deg(self) -> float:
        """Where it is when the emulator starts: where its movement begins, or at 90 degrees."""
        first = self.movement.get("angle_deg", self.movement.get("from_deg", 90.0))
        with contextlib.suppress(TypeError, IndexError, KeyError):  # the mover says what is wrong with its points
            first = self.movement["points"][0][1]
        return within("start", first, SMALLEST_DEG, LARGEST_DEG)


def read(text: str) -> Arm:
    """The arm that `--arm` names.

    Raises ArmError: it is neither a mode with settings nor a readable file that describes an arm.
    """
    mode, *pairs = text.split(",")
    if mode in MOVERS:
        return Arm(mode, dict(_number(_halves(pair)) for pair in pairs))
    path = Path(text)
    if path.suffix.lower() in {".toml", ".json"} or path.exists():
        return _from_file(path)
    raise ArmError(f"--arm {text}: neither a file nor one of {', '.join(MOVERS)}")


def set_laws(arm: Arm, texts: Sequence[str]) -> Arm:
    """The arm with other laws, each as `PLACE=NAME[,PARAMETER=NUMBER…]`.

    Raises ArmError: there is no such place, law or parameter.
    """
    laws = {}
    for text in texts:
        (place, name), *parameters = (_halves(pair) for pair in text.split(","))
        laws[place] = law(place, name, dict(map(_number, parameters)))
    return replace(arm, tissue=replace(arm.tissue, **laws))


def _halves(pair: str) -> tuple[str, str]:
    key, _, value = pair.partition("=")
    return key, value


def _number(halves: tuple[str, str]) -> tuple[str, float]:
    key, value = halves
    try:
        return key, float(value)
    except ValueError:
        raise ArmError(f"--arm: '{key}={value}' must be SETTING=NUMBER") from None


def _from_file(path: Path) -> Arm:
    described = read_table(path, ArmError, f"a table of {', '.join(KEYS)}")
    if set(described) - set(KEYS):
        raise ArmError(f"{path}: an arm's file is a table of {', '.join(KEYS)}")
    tables = {key: described.get(key, {}) for key in KEYS[1:]}
    for key, table in tables.items():
        if not isinstance(table, dict):
            raise ArmError(f"{path}: '{key}' must be a table")
    try:
        return Arm(str(described.get("mode", "held")), tables.pop("movement"), _tissue(tables))
    except ArmError as error:
        raise ArmError(f"{path}: {error}") from None


def _tissue(tables: dict[str, dict[str, Any]]) -> Tissue:
    mechanics = build(Mechanics, "mechanics", tables.pop("mechanics"))
    laws = {}
    for place, table in tables.items():
        parameters = {key: value for key, value in table.items() if key != "law"}
        laws[place] = law(place, str(table.get("law", DEFAULT_LAWS[place])), parameters)
    return Tissue(**laws, mechanics=mechanics)
