"""An arm as the command line describes it: by `--arm MODE[,SETTING=NUMBER…]` and `--arm-law PLACE=NAME[,…]`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from stimrig.hardware_sim.arm.motion import LARGEST_DEG, SMALLEST_DEG, within
from stimrig.hardware_sim.arm.tissue import Tissue, law
from stimrig.hardware_sim.errors import HardwareSimError


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
        return within("start", first, SMALLEST_DEG, LARGEST_DEG)


def read(text: str) -> Arm:
    """The arm that `--arm` describes. Raises HardwareSimError: a setting is no number."""
    mode, *pairs = text.split(",")
    return Arm(mode, dict(map(_number, pairs)))


def set_laws(arm: Arm, texts: Sequence[str]) -> Arm:
    """The arm with other laws, each as `--arm-law` takes it.

    Raises HardwareSimError: there is no such place, law or parameter.
    """
    laws = {}
    for text in texts:
        head, *parameters = text.split(",")
        place, _, name = head.partition("=")
        laws[place] = law(place, name, dict(map(_number, parameters)))
    return replace(arm, tissue=replace(arm.tissue, **laws))


def _number(pair: str) -> tuple[str, float]:
    key, _, value = pair.partition("=")
    try:
        return key, float(value)
    except ValueError:
        raise HardwareSimError(f"--arm: '{pair}' must be SETTING=NUMBER") from None
