"""The arm's laws together: g(x, ẋ), 1 at the reference angle at rest, and h(x, ẋ).

The reference angle is that at which the muscle alone, without a moving joint, is described: 90 degrees.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stimrig.hardware_sim.arm import passive, torque_angle, torque_velocity
from stimrig.hardware_sim.arm.law import AngleLaw, Number, PassiveLaw, VelocityLaw
from stimrig.hardware_sim.arm.mechanics import Mechanics
from stimrig.hardware_sim.errors import ArmError
from stimrig.hardware_sim.scan import modules_with

REFERENCE_RAD = math.pi / 2.0
PLACES = {"passive": passive, "torque_angle": torque_angle, "torque_velocity": torque_velocity}
DEFAULT_LAWS = {"passive": "double_exponential", "torque_angle": "force_length", "torque_velocity": "hill"}


def law(place: str, name: str, parameters: Mapping[str, Any] | None = None) -> Any:
    """The named law of a place, with some of its parameters overridden.

    Raises
    ------
    ArmError
        There is no such place, law or parameter, or a value is not a finite number or out of range.
    """
    if place not in PLACES:
        raise ArmError(f"the arm has no laws of {place!r}; it has {', '.join(PLACES)}")
    modules = modules_with(PLACES[place], "Law")
    if name not in modules:
        raise ArmError(f"unknown law of {place} {name!r}; there are {', '.join(modules)}")
    return built(modules[name].Law, f"law {name} of {place}", parameters or {})


def built(kind: Any, what: str, parameters: Mapping[str, Any]) -> Any:
    """The dataclass of numbers `kind` with these parameters; its `ABOVE` says what some must be above.

    Raises
    ------
    ArmError
        It has no such parameter, or a value is not a finite number or out of range.
    """
    known = [each.name for each in dataclasses.fields(kind)]
    for key, value in parameters.items():
        if key not in known:
            raise ArmError(f"{what} has no parameter '{key}'; it has {', '.join(known) or 'none'}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ArmError(f"parameter '{key}' of {what} must be a finite number, not {value!r}")
        lowest = getattr(kind, "ABOVE", {}).get(key, -math.inf)
        if not value > lowest:
            raise ArmError(f"parameter '{key}' of {what} must be above {lowest:g}, not {value!r}")
    return kind(**parameters)


@dataclass(frozen=True)
class Tissue:
    """The laws of one arm and its mechanics."""

    passive: PassiveLaw = field(default_factory=lambda: law("passive", DEFAULT_LAWS["passive"]))
    torque_angle: AngleLaw = field(default_factory=lambda: law("torque_angle", DEFAULT_LAWS["torque_angle"]))
    torque_velocity: VelocityLaw = field(
        default_factory=lambda: law("torque_velocity", DEFAULT_LAWS["torque_velocity"])
    )
    mechanics: Mechanics = field(default_factory=Mechanics)

    def g(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Factor on the isometric torque at the reference angle."""
        angle = self.torque_angle.share(angle_rad) / self.torque_angle.share(REFERENCE_RAD)
        return angle * self.torque_velocity.share(angle_rad, velocity_rad_s)

    def h_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Torque of the relaxed arm, N·m: tissue that has been there for long, stops and gravity."""
        still = self.passive.torque_nm(angle_rad, velocity_rad_s)
        return still + self.mechanics.stops_nm(angle_rad, velocity_rad_s) + self.mechanics.gravity_nm(angle_rad)


def bare() -> Tissue:
    """No tissue, no mass and no stops: the joint's torque is the muscle's own, whatever that makes of the movement."""
    laws = {place: law(place, "none") for place in PLACES}
    return Tissue(**laws, mechanics=Mechanics(inertia_kg_m2=0.0, stop_nm_per_rad=0.0))
