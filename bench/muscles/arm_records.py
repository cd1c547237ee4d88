"""Offline records of an arm whose truth is known, for developing and judging what identifies g(x, ẋ) and h(x, ẋ).

Simulated at 1600 Hz, sampled at 400 Hz. The joint is moved by the emulator's hand or robot; a fixture that holds it
yields by up to 3 mrad/N·m, as fixtures do. Angle and velocity are what a rig records: an encoder of 13 bits with noise
of 0.02 degrees at 200 Hz, the velocity by a local quadratic over 60 ms, centred, both interpolated to the torque's
times. The torque has white noise of U(0.05, 0.1) N·m.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.signal import savgol_filter

from bench.muscles.arm_patient import ArmPatient, arm_patient
from stimrig.hardware_sim.arm.laws import Floats
from stimrig.hardware_sim.arm.motion import Begin, Motion, Quintic, lasting_s
from stimrig.hardware_sim.arm.movers import make_mover
from stimrig.hardware_sim.hidden.design import PULSES_PER_S, levels, make_design
from stimrig.hardware_sim.hidden.scenario import rng_of

__all__ = ["KINDS", "arm_patient", "changed", "record"]

RATE_HZ, ANGLE_HZ = 400, 200
VELOCITY_WINDOW_S = 0.060
SIMULATION_HZ = 1600
LARGEST_COMPLIANCE_RAD_PER_NM = 0.003
Parts = list[tuple[str, Floats]]
"""Segments in order: name, and pulse widths at 40 pulses/s, µs."""
Moves = list[tuple[float, str, dict[str, Any]]]
"""From this time on, s, this mode of the arm with these settings."""


@dataclass(frozen=True)
class AngleSensor:
    """Sensor of the joint's angle, read at `ANGLE_HZ`: white noise, then steps; its times are `delay_s` too late."""

    noise_deg: float = 0.02
    step_deg: float = 360.0 / 2**13
    delay_s: float = 0.0


ENCODER = AngleSensor()


@dataclass(frozen=True)
class RecordRequest:
    """Arguments of `bench.muscles.arm_records.record`, which documents the fields."""

    patient: ArmPatient
    rng: Generator
    mover: str
    angle_rad: float | None = None
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


def staircase(top: float, steps: int, held_s: float) -> Floats:
    """Up in equal steps, each held so long, down again, and a rest."""
    up = np.arange(1, steps + 1) / steps
    return np.repeat(np.concatenate([up, up[-2::-1], [0.0]]) * top, round(held_s * PULSES_PER_S))


def _rest(seconds: float) -> tuple[str, Floats]:
    return "rest", np.zeros(round(seconds * PULSES_PER_S))


def _fine(parts: Parts) -> Floats:
    return np.repeat(np.concatenate([widths for _, widths in parts]), SIMULATION_HZ // PULSES_PER_S)


def _at_angle(request: RecordRequest, angle_rad: float, parts: Parts) -> ArmDesign:
    """At this angle, in a fixture that yields by the torque."""
    patient, yields = request.patient, float(request.rng.uniform(0.0, LARGEST_COMPLIANCE_RAD_PER_NM))
    isometric_nm = patient.isometric_nm(_fine(parts), 1.0 / SIMULATION_HZ)
    return ArmDesign(parts, angle_rad + yields * patient.g(angle_rad, 0.0) * isometric_nm)


def _isometric(request: RecordRequest) -> ArmDesign:
    at_rad = request.patient.reference_rad if request.angle_rad is None else request.angle_rad
    design = make_design("full", request.rng, request.top_us, with_validate=False)
    borders = np.flatnonzero(design.segment[1:] != design.segment[:-1]) + 1
    widths, names = np.split(design.width_us, borders), np.split(design.segment, borders)
    return _at_angle(request, at_rad, [(str(name[0]), width) for name, width in zip(names, widths, strict=True)])


def _somewhere(request: RecordRequest) -> ArmDesign:
    drawn_rad = float(request.rng.uniform(*request.patient.range_rad))
    return _staircase_at(request, drawn_rad if request.angle_rad is None else request.angle_rad)


def _staircase_at(request: RecordRequest, angle_rad: float) -> ArmDesign:
    steps = np.round(staircase(request.top_us, 5, 1.0))
    return _at_angle(request, angle_rad, request.parts or [_rest(1.0), ("staircase", steps), _rest(1.5)])


def _passive(request: RecordRequest) -> ArmDesign:
    seconds = request.duration_s or 66.0
    moves = [
        (share * seconds, *_sweeps(request, deg_s * float(request.rng.uniform(0.85, 1.15))))
        for share, deg_s in ((0.0, 8.0), (0.4, 20.0), (0.66, 45.0), (0.84, 80.0))
    ]
    parts = [("passive", np.zeros(round(seconds * PULSES_PER_S)))]
    return ArmDesign(parts, _moved(request, moves, parts))


def _moving(request: RecordRequest) -> ArmDesign:
    parts = request.parts or _steady(request.rng, request.top_us, request.duration_s or 60.0)
    seconds = sum(widths.size for _, widths in parts) / PULSES_PER_S
    speeds = request.rng.permutation([15.0, 35.0, 60.0])
    moves = [(third * seconds / 3.0, *_sweeps(request, float(deg_s))) for third, deg_s in enumerate(speeds)]
    return ArmDesign(parts, _moved(request, moves, parts))


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


def _unseen(request: RecordRequest) -> ArmDesign:
    seconds, rng = request.duration_s or 30.0, request.rng
    parts = [_rest(2.0), ("validate", np.round(levels(rng, request.top_us, seconds - 4.0))), _rest(2.0)]
    time_s = np.arange(_fine(parts).size) / SIMULATION_HZ
    hz, phase = rng.uniform(0.05, 0.6, 4), rng.uniform(0.0, 2.0 * math.pi, 4)
    waves = np.sin(2.0 * math.pi * hz * time_s[:, None] + phase) @ rng.uniform(0.3, 1.0, 4)
    low, high = request.patient.range_rad
    return ArmDesign(parts, low + (high - low) * (waves - waves.min()) / np.ptp(waves))


def _reaching(request: RecordRequest) -> ArmDesign:
    """As `_unseen`, by movements of minimum jerk from one angle to another, with pauses."""
    parts, (low, high), rng = _unseen(request).parts, request.patient.range_rad, request.rng
    time_s = np.arange(_fine(parts).size) / SIMULATION_HZ
    begin_s, at, angle = 0.0, Motion(float(rng.uniform(low, high))), np.empty(time_s.size)
    while begin_s < time_s[-1]:
        to = Motion(float(rng.uniform(low, high)))
        lasts_s = lasting_s(at.angle_rad, to.angle_rad, math.radians(rng.uniform(20.0, 90.0)))
        way, end_s = Quintic(begin_s, lasts_s, at, to), begin_s + lasts_s + float(rng.uniform(0.0, 1.0))
        for row in np.flatnonzero((time_s >= begin_s) & (time_s < end_s)):
            angle[row] = way.at(float(time_s[row])).angle_rad
        begin_s, at = end_s, to
    return ArmDesign(parts, angle)


def _sweeps(request: RecordRequest, deg_s: float) -> tuple[str, dict[str, Any]]:
    """Through the range of the day, a little inside its ends."""
    low_deg, high_deg = np.degrees(request.patient.range_rad)
    return request.mover, {"from_deg": float(low_deg) + 3.0, "to_deg": float(high_deg) - 3.0, "deg_s": deg_s}


def _moved(request: RecordRequest, moves: Moves, parts: Parts) -> Floats:
    """Angles at the simulation's rate, by the emulator's movers one after another, from the middle of the range."""
    motion, mover, coming = Motion(0.5 * sum(request.patient.range_rad)), None, list(moves)
    seeds = request.rng.integers(1 << 31, size=len(moves)).tolist()
    angle = np.empty(_fine(parts).size)
    for k in range(angle.size):
        time_s = k / SIMULATION_HZ
        motion = mover(time_s) if mover else motion
        while coming and coming[0][0] <= time_s:
            _, mode, settings = coming.pop(0)
            mover = make_mover(mode, Begin(time_s, motion, seeds[len(coming)]), settings)
        angle[k] = motion.angle_rad
    return angle


KINDS: dict[str, Callable[[RecordRequest], ArmDesign]] = {
    "isometric": _isometric,
    "held": _somewhere,
    "passive": _passive,
    "moving": _moving,
    "unseen": _unseen,
    "reaching": _reaching,
}


def record(
    patient: ArmPatient,
    kind: str,
    seed: int,
    *,
    angle_rad: float | None = None,
    duration_s: float | None = None,
    parts: Parts | None = None,
    sensor: AngleSensor = ENCODER,
) -> dict[str, Any]:
    """One record of an arm.

    Parameters
    ----------
    kind
        `isometric`: at `angle_rad` (90 degrees if None), the paper's PRBS, then a ramp. `held`: a short staircase at
        `angle_rad`, or anywhere in the range. `passive`: no current; sweeps at about 8, 20, 45 and 80 degrees/s.
        `moving`: steady levels, 3 to 7 s each, while the joint is swept. `unseen`: random levels and another movement,
        for validation. `reaching`: as `unseen`, by movements of minimum jerk.
    seed
        Decides, together with patient and kind, every random number.
    duration_s
        Length of `passive`, `moving`, `unseen` or `reaching`; 66, 60, 30 and 30 if None. Others have their protocol's.
    parts
        Of `held` or `moving`: segments in order, each a name and its pulse widths at 40 pulses/s, µs, instead of the
        kind's own.
    sensor
        What reads the angle; by default a good encoder.

    Returns
    -------
    dict
        `time_s`, `pulse_width_us`, `torque_nm`, `angle_rad`, `velocity_rad_s`, `segment`, shape (n,), and `truth`: the
        same rows without noise (`torque_nm`, `isometric_nm`, `passive_nm`, `angle_rad`, `velocity_rad_s`,
        `acceleration_rad_s2`), `noise_sd_nm`, `mover` and `patient`.

    Raises
    ------
    ValueError
        No such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind {kind!r}: one of {', '.join(KINDS)}")
    rng = rng_of(seed, "arm record", str(patient.seed), kind)
    mover = str(rng.choice(["hand", "robot"]))
    sd_nm = float(rng.uniform(0.05, 0.1))
    design = KINDS[kind](RecordRequest(patient, rng, mover, angle_rad, duration_s, parts))
    clean = _simulated(patient, design)
    every = SIMULATION_HZ // RATE_HZ
    rows = {name: column[::every] for name, column in clean.items()}
    time_s = np.arange(rows["torque_nm"].size) / RATE_HZ
    angle, velocity = _measured(rng, clean["angle_rad"], time_s, sensor)
    pulse_of_row = (time_s * PULSES_PER_S + 1e-9).astype(int)
    return {
        "time_s": time_s,
        "pulse_width_us": design.width_us[pulse_of_row],
        "torque_nm": rows["torque_nm"] + rng.normal(0.0, sd_nm, time_s.size),
        "angle_rad": angle,
        "velocity_rad_s": velocity,
        "segment": design.segment[pulse_of_row],
        "truth": {**rows, "noise_sd_nm": sd_nm, "mover": mover, "kind": kind, "patient": patient.truth},
    }


def changed(
    original: dict[str, Any],
    *,
    scale: float = 1.0,
    offset_nm: float = 0.0,
    start_s: float = 0.0,
    time_shift_s: float = 0.0,
    angle_error_rad: float = 0.0,
) -> dict[str, Any]:
    """The record as another recorder gives it; `truth` stays with the arm.

    Torque × `scale` (negative: the cell turned round) + `offset_nm`; without its first `start_s`; its clock shifted;
    the angle off by a calibration's error.
    """
    first = round(start_s * RATE_HZ)
    columns = {name: column[first:].copy() for name, column in original.items() if isinstance(column, np.ndarray)}
    columns["time_s"] += time_shift_s - start_s
    columns["torque_nm"] = columns["torque_nm"] * scale + offset_nm
    columns["angle_rad"] += angle_error_rad
    truth = {
        name: value[first:].copy() if isinstance(value, np.ndarray) else value
        for name, value in original["truth"].items()
    }
    return {**columns, "truth": truth}


def _simulated(patient: ArmPatient, design: ArmDesign) -> dict[str, Floats]:
    step_s, angle_rad = 1.0 / SIMULATION_HZ, design.angle_rad
    velocity = np.gradient(angle_rad, step_s)
    acceleration = np.gradient(velocity, step_s)
    isometric = patient.isometric_nm(design.fine_width_us, step_s)
    passive = patient.h_nm(angle_rad, velocity) + patient.remembered_nm(angle_rad, step_s)
    torque = patient.g(angle_rad, velocity) * isometric + passive - patient.inertia_kg_m2 * acceleration
    return {
        "torque_nm": torque,
        "isometric_nm": isometric,
        "passive_nm": passive,
        "angle_rad": angle_rad,
        "velocity_rad_s": velocity,
        "acceleration_rad_s2": acceleration,
    }


def _measured(rng: Generator, angle_rad: Floats, time_s: Floats, sensor: AngleSensor) -> tuple[Floats, Floats]:
    """Return angle and velocity at the torque's times, as sensor and rig record them."""
    every = SIMULATION_HZ // ANGLE_HZ
    first = int(rng.integers(every))
    true_deg = np.degrees(angle_rad[first::every])
    read_deg = np.round((true_deg + rng.normal(0.0, sensor.noise_deg, true_deg.size)) / sensor.step_deg)
    read_rad = np.radians(read_deg * sensor.step_deg)
    at_s = (first + every * np.arange(read_rad.size)) / SIMULATION_HZ + sensor.delay_s
    window = 2 * round(0.5 * VELOCITY_WINDOW_S * ANGLE_HZ) + 1
    velocity = np.asarray(savgol_filter(read_rad, window, 2, deriv=1, delta=1.0 / ANGLE_HZ), float)
    return np.interp(time_s, at_s, read_rad), np.interp(time_s, at_s, velocity)
