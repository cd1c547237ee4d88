"""A muscle in an arm: what the load cell between the forearm and whatever holds it measures.

Of the forearm: I ẍ = active + passive + gravity − cell. So the cell measures

    T = g(x, ẋ) · isometric(f, G) + h(x, ẋ) − I ẍ,    flexion positive,

where `isometric` is the muscle's torque at the reference angle, h is passive torque, stops and gravity, and I is the
inertia of forearm, hand and all that moves with them on the muscle's side of the cell. What the holder's side of the
cell weighs does not appear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from stimrig.hardware_sim.arm.motion import LARGEST_DEG, SMALLEST_DEG, Begin, Motion, within
from stimrig.hardware_sim.arm.movers import make_mover
from stimrig.hardware_sim.arm.tissue import Tissue, law
from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.muscle import Muscle

LONGEST_STEP_S = 1.0 / 1600.0
SEEDS_APART = 1 << 32
"""No two movements of one limb are alike, nor those of two limbs with neighbouring seeds."""


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


def read_arm(text: str) -> Arm:
    """The arm that `--arm MODE[,SETTING=NUMBER…]` describes. Raises HardwareSimError: a setting is no number."""
    mode, *pairs = text.split(",")
    return Arm(mode, dict(map(_number, pairs)))


def set_laws(arm: Arm, texts: Sequence[str]) -> Arm:
    """The arm with other laws, each as `--arm-law PLACE=NAME[,PARAMETER=NUMBER…]` takes it.

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


class Limb:
    """A muscle whose joint moves; it implements the `Muscle` protocol for load cell and electrodes.

    Time advances in steps of at most 1/1600 s. A muscle that itself depends on the joint has a method
    `joint(angle_rad, velocity_rad_s)`, which is told of each step before the muscle takes it.
    """

    def __init__(self, muscle: Muscle, arm: Arm, seed: int = 0) -> None:
        self._seed, self._moves = seed, 0
        self.motion = Motion(math.radians(arm.start_deg))
        self.converted_nm = getattr(muscle, "converted_nm", None)
        self._muscle, self._tissue = muscle, arm.tissue
        self._tell_joint: Callable[[float, float], None] | None = getattr(muscle, "joint", None)
        self._laws = lru_cache(1)(self._laws_at)  # an arm that is held asks for one place again and again
        self._memory = arm.tissue.passive.begin(self.motion.angle_rad)
        self._time_s = 0.0
        self._isometric_nm = 0.0
        self.move(arm.mode, arm.movement)

    def move(self, mode: str, settings: Mapping[str, Any], time_s: float = 0.0) -> None:
        """Hold or move the forearm otherwise from now on.

        Raises HardwareSimError: there is no such mode, or a setting makes no sense; then it goes on as before.
        """
        self._advance(time_s)
        begin = Begin(self._time_s, self.motion, self._seed + SEEDS_APART * self._moves)
        self._motion_at = make_mover(mode, begin, settings)
        self.mode, self._moves = mode, self._moves + 1

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        self._advance(time_s)
        self._muscle.pulse(time_s, width_us, current_ma)

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the torque on the load cell, N·m, without the sensor's noise."""
        self._advance(time_s)
        angle_rad, velocity_rad_s, acceleration_rad_s2 = self.motion
        share, passive_nm = self._laws(angle_rad, velocity_rad_s)
        remembered_nm = self._tissue.passive.remembered_nm(self._memory, angle_rad)
        held_nm = float(share * self._isometric_nm + passive_nm + remembered_nm)
        return held_nm - self._tissue.mechanics.inertia_kg_m2 * acceleration_rad_s2

    def angle_deg(self, time_s: float) -> float:
        """Advance to `time_s` and give the true angle there, degrees."""
        self._advance(time_s)
        return math.degrees(self.motion.angle_rad)

    def state(self) -> dict[str, Any]:
        """True angle and velocity, and what moves it."""
        return {
            "arm": self.mode,
            "angle_deg": math.degrees(self.motion.angle_rad),
            "velocity_deg_s": math.degrees(self.motion.velocity_rad_s),
        }

    def _advance(self, time_s: float) -> None:
        span_s = time_s - self._time_s
        if span_s <= 0.0:
            return
        steps = max(1, math.ceil(span_s / LONGEST_STEP_S - 1e-9))
        begin_s = self._time_s
        for step in range(1, steps + 1):
            self._step_to(begin_s + step * span_s / steps)

    def _step_to(self, time_s: float) -> None:
        self.motion = self._motion_at(time_s)
        angle_rad, velocity_rad_s, _ = self.motion
        self._memory = self._tissue.passive.step(self._memory, angle_rad, time_s - self._time_s)
        if self._tell_joint is not None:
            self._tell_joint(angle_rad, velocity_rad_s)
        self._isometric_nm = self._muscle.torque_nm(time_s)
        self._time_s = time_s

    def _laws_at(self, angle_rad: float, velocity_rad_s: float) -> tuple[Any, Any]:
        """Share of active torque, and the torque of what is passive, N·m."""
        return self._tissue.g(angle_rad, velocity_rad_s), self._tissue.h_nm(angle_rad, velocity_rad_s)
