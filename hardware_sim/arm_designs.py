"""What is asked of an arm offline: pulse widths segment by segment, and how the joint moves meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.arm import registry
from stimrig.hardware_sim.arm.law import Floats
from stimrig.hardware_sim.arm.motion import Begin, Motion, MoverProtocol
from stimrig.hardware_sim.arm_patient import ArmPatient
from stimrig.hardware_sim.hidden.design import PULSES_PER_S, levels, make_design, staircase

SIMULATION_HZ = 1600
LARGEST_COMPLIANCE_RAD_PER_NM = 0.003
Parts = list[tuple[str, Floats]]
"""Segments in order: name, and pulse widths at 40 pulses/s, µs."""
Moves = list[tuple[float, str, dict[str, Any]]]
"""From this time on, s, this mode of the arm with these settings."""


@dataclass(frozen=True)
class Asked:
    """A record that is wanted; `stimrig.hardware_sim.arm_records.record` says what the fields mean."""

    patient: ArmPatient
    rng: Generator
    mover: str
    angle_rad: float | None = None
    protocol: str = "prbs"
    duration_s: float | None = None
    parts: Parts | None = None

    @property
    def top_us(self) -> float:
        """The largest pulse width."""
        return float(self.patient.largest_width_us)


@dataclass(frozen=True)
class ArmDesign:
    """Segments, and the true angle at the simulation's rate, rad."""

    parts: Parts
    angle_rad: Floats

    @property
    def width_us(self) -> Floats:
        """Pulse widths at 40 pulses/s."""
        return np.concatenate([widths for _, widths in self.parts])

    @property
    def segment(self) -> np.ndarray:
        """The segment of each pulse."""
        return np.concatenate([np.full(len(widths), name, dtype="U12") for name, widths in self.parts])

    @property
    def fine_width_us(self) -> Floats:
        """Pulse widths at the simulation's rate."""
        return _fine(self.parts)


def _rest(seconds: float) -> tuple[str, Floats]:
    return "rest", np.zeros(round(seconds * PULSES_PER_S))


def _fine(parts: Parts) -> Floats:
    return np.repeat(np.concatenate([widths for _, widths in parts]), SIMULATION_HZ // PULSES_PER_S)


def _held(asked: Asked, angle_rad: float, parts: Parts) -> ArmDesign:
    """At this angle, in a fixture that yields by the torque."""
    patient, yields = asked.patient, float(asked.rng.uniform(0.0, LARGEST_COMPLIANCE_RAD_PER_NM))
    isometric_nm = patient.isometric_nm(_fine(parts), 1.0 / SIMULATION_HZ)
    return ArmDesign(parts, angle_rad + yields * patient.g(angle_rad, 0.0) * isometric_nm)


def _isometric(asked: Asked) -> ArmDesign:
    at_rad = asked.patient.reference_rad if asked.angle_rad is None else asked.angle_rad
    if asked.protocol == "staircase":
        return _staircase_at(asked, at_rad)
    if asked.protocol != "prbs":
        raise ValueError(f"protocol {asked.protocol!r}: prbs or staircase")
    design = make_design("full", asked.rng, asked.top_us, with_validate=False)
    borders = np.flatnonzero(design.segment[1:] != design.segment[:-1]) + 1
    widths, names = np.split(design.width_us, borders), np.split(design.segment, borders)
    return _held(asked, at_rad, [(str(name[0]), width) for name, width in zip(names, widths, strict=True)])


def _somewhere(asked: Asked) -> ArmDesign:
    drawn_rad = float(asked.rng.uniform(*asked.patient.range_rad))
    return _staircase_at(asked, drawn_rad if asked.angle_rad is None else asked.angle_rad)


def _staircase_at(asked: Asked, angle_rad: float) -> ArmDesign:
    steps = np.round(staircase(asked.top_us, 5, 1.0))
    return _held(asked, angle_rad, asked.parts or [_rest(1.0), ("staircase", steps), _rest(1.5)])


def _passive(asked: Asked) -> ArmDesign:
    seconds = asked.duration_s or 66.0
    moves = [
        (share * seconds, *_sweeps(asked, deg_s * float(asked.rng.uniform(0.85, 1.15))))
        for share, deg_s in ((0.0, 8.0), (0.4, 20.0), (0.66, 45.0), (0.84, 80.0))
    ]
    parts = [("passive", np.zeros(round(seconds * PULSES_PER_S)))]
    return ArmDesign(parts, _moved(asked, moves, parts))


def _moving(asked: Asked) -> ArmDesign:
    parts = asked.parts or _steady(asked.rng, asked.top_us, asked.duration_s or 60.0)
    seconds = sum(widths.size for _, widths in parts) / PULSES_PER_S
    speeds = asked.rng.permutation([15.0, 35.0, 60.0])
    moves = [(third * seconds / 3.0, *_sweeps(asked, float(deg_s))) for third, deg_s in enumerate(speeds)]
    return ArmDesign(parts, _moved(asked, moves, parts))


def _steady(rng: Generator, top_us: float, seconds: float) -> Parts:
    """Levels of 3 to 7 s between two rests."""
    left_s = seconds - 4.0
    shares: list[Floats] = []
    while left_s > 0.0:
        lasts_s = min(float(rng.uniform(3.0, 7.0)), left_s)
        share = 0.0 if rng.random() < 0.1 else float(rng.uniform(0.25, 1.0))
        shares.append(np.full(round(lasts_s * PULSES_PER_S), np.round(share * top_us)))
        left_s -= lasts_s
    return [_rest(2.0), ("levels", np.concatenate(shares)), _rest(2.0)]


def _unseen(asked: Asked) -> ArmDesign:
    seconds, rng = asked.duration_s or 30.0, asked.rng
    parts = [_rest(2.0), ("validate", np.round(levels(rng, asked.top_us, seconds - 4.0))), _rest(2.0)]
    time_s = np.arange(_fine(parts).size) / SIMULATION_HZ
    hz, phase = rng.uniform(0.05, 0.6, 4), rng.uniform(0.0, 2.0 * math.pi, 4)
    waves = np.sin(2.0 * math.pi * hz * time_s[:, None] + phase) @ rng.uniform(0.3, 1.0, 4)
    low, high = asked.patient.range_rad
    return ArmDesign(parts, low + (high - low) * (waves - waves.min()) / np.ptp(waves))


def _sweeps(asked: Asked, deg_s: float) -> tuple[str, dict[str, Any]]:
    """Through the range of the day, a little inside its ends."""
    low_deg, high_deg = np.degrees(asked.patient.range_rad)
    return asked.mover, {"from_deg": float(low_deg) + 3.0, "to_deg": float(high_deg) - 3.0, "deg_s": deg_s}


def _moved(asked: Asked, moves: Moves, parts: Parts) -> Floats:
    """Angles at the simulation's rate, by the emulator's movers one after another, from the middle of the range."""
    motion, mover, coming = Motion(0.5 * sum(asked.patient.range_rad)), None, list(moves)
    seeds = asked.rng.integers(1 << 31, size=len(moves)).tolist()
    angle = np.empty(_fine(parts).size)
    for k in range(angle.size):
        time_s = k / SIMULATION_HZ
        motion = _advanced(mover, time_s, motion)
        while coming and coming[0][0] <= time_s:
            _, mode, settings = coming.pop(0)
            mover = registry.make(mode, Begin(time_s, motion, seeds[len(coming)]), settings)
        angle[k] = motion.angle_rad
    return angle


def _advanced(mover: MoverProtocol | None, time_s: float, motion: Motion) -> Motion:
    return mover.advance(time_s, lambda _angle_rad, _velocity_rad_s: 0.0) if mover else motion


KINDS: dict[str, Callable[[Asked], ArmDesign]] = {
    "isometric": _isometric,
    "held": _somewhere,
    "passive": _passive,
    "moving": _moving,
    "unseen": _unseen,
}
