"""The arm's laws together: g(x, ẋ), 1 at the reference angle at rest, and h(x, ẋ); and the forearm as a body.

The reference angle is that at which the muscle alone, without a moving joint, is described: 90 degrees.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stimrig.hardware_sim.arm.laws import LAWS, Number, PassiveLaw, above
from stimrig.hardware_sim.errors import HardwareSimError

REFERENCE_RAD = math.pi / 2.0
DEFAULT_LAWS = {"passive": "double_exponential", "torque_angle": "force_length", "torque_velocity": "hill"}


@dataclass(frozen=True)
class Mechanics:
    """The forearm as a rigid body in a plane.

    Gravity pulls with -weight_nm · sin(angle + upper_arm_deg): the upper arm hangs down at 0 degrees, where the
    straight arm needs no torque, and points forward at 90. `weight_nm` 0 (as it is unless given) is a forearm in a
    horizontal plane. Beyond `least_deg` and `most_deg` a stop pushes back, stiffer while it is being compressed, and
    never pulls (Hunt and Crossley 1975).

    Winter 2009, table 4.1: forearm and hand have 0.022 of the body's mass, the centre of mass at 0.682 and a radius of
    gyration about the elbow of 0.827 of the length from elbow to wrist. For 75 kg and 0.254 m: 1.65 kg, an inertia of
    0.073 kg·m², and 2.8 N·m when it is horizontal.
    """

    inertia_kg_m2: float = above(0.0, 0.07)
    weight_nm: float = 0.0
    upper_arm_deg: float = 0.0
    least_deg: float = -5.0
    most_deg: float = 145.0
    stop_nm_per_rad: float = above(0.0, 200.0)
    stop_loss_s_per_rad: float = 0.5

    def gravity_nm(self, angle_rad: Number) -> Number:
        """Gravity's torque on the elbow, flexion positive."""
        return -self.weight_nm * np.sin(angle_rad + math.radians(self.upper_arm_deg))

    def stops_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Return the torque of the stops, flexion positive."""
        over = np.maximum(angle_rad - math.radians(self.most_deg), 0.0)
        under = np.maximum(math.radians(self.least_deg) - angle_rad, 0.0)
        flexed = over * np.maximum(1.0 + self.stop_loss_s_per_rad * velocity_rad_s, 0.0)
        extended = under * np.maximum(1.0 - self.stop_loss_s_per_rad * velocity_rad_s, 0.0)
        return self.stop_nm_per_rad * (extended - flexed)


PLACES: dict[str, dict[str, Any]] = {**LAWS, "mechanics": {"forearm": Mechanics}}
"""What can be chosen of an arm: a law of each place, and the numbers of the forearm."""


def law(place: str, name: str, parameters: Mapping[str, float] | None = None) -> Any:
    """The named law of a place, with some of its parameters overridden.

    Raises HardwareSimError: there is no such place, law or parameter, or a value is no number or out of range.
    """
    if place not in PLACES:
        raise HardwareSimError(f"the arm has no laws of {place!r}; it has {', '.join(PLACES)}")
    if name not in PLACES[place]:
        raise HardwareSimError(f"unknown law of {place} {name!r}; there are {', '.join(PLACES[place])}")
    kind, what, values = PLACES[place][name], f"law {name} of {place}", parameters or {}
    lowest = {each.name: each.metadata.get("above", -math.inf) for each in dataclasses.fields(kind)}
    for key, value in values.items():
        if key not in lowest:
            raise HardwareSimError(f"{what} has no parameter '{key}'; it has {', '.join(lowest) or 'none'}")
        if not math.isfinite(value):
            raise HardwareSimError(f"parameter '{key}' of {what} must be a finite number, not {value!r}")
        if not value > lowest[key]:
            raise HardwareSimError(f"parameter '{key}' of {what} must be above {lowest[key]:g}, not {value!r}")
    return kind(**values)


def law_name(place: str, law: Any) -> str:
    """The name by which `law` gives it."""
    return next(name for name, kind in LAWS[place].items() if type(law) is kind)


@dataclass(frozen=True)
class Tissue:
    """The laws of one arm and its mechanics."""

    passive: PassiveLaw = field(default_factory=LAWS["passive"][DEFAULT_LAWS["passive"]])
    torque_angle: Any = field(default_factory=LAWS["torque_angle"][DEFAULT_LAWS["torque_angle"]])
    torque_velocity: Any = field(default_factory=LAWS["torque_velocity"][DEFAULT_LAWS["torque_velocity"]])
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
    laws = {place: law(place, "none") for place in LAWS}
    return Tissue(**laws, mechanics=Mechanics(inertia_kg_m2=0.0, stop_nm_per_rad=0.0))
