"""The test design: pulse widths at 40 pulses/s, segment by segment, and how the joint moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.hidden.kernels import Floats

PULSES_PER_S = 40
DESIGNS = ("full", "short")
UNRECORDED = "unrecorded"
"""Segment of a pause between two tests."""


@dataclass(frozen=True)
class Design:
    """Pulse widths held over each 25 ms, shape (n,), the segment of each, and the joint's movement (or None)."""

    width_us: Floats
    segment: np.ndarray
    movement: tuple[Floats, Floats, Floats] | None = None  # frequencies Hz, amplitudes rad, phases rad

    @property
    def held_out(self) -> np.ndarray:
        """Mask of the rows that must not be fitted."""
        return self.segment == "validate"

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return self.width_us.size / PULSES_PER_S

    def then(self, pause_s: float, second: Design) -> Design:
        """This test, an unrecorded pause and a second test; the joint keeps moving."""
        pause = round(pause_s * PULSES_PER_S)
        width_us = np.concatenate([self.width_us, np.zeros(pause), second.width_us])
        segment = np.concatenate([self.segment, np.full(pause, UNRECORDED), second.segment])
        return replace(self, width_us=width_us, segment=segment)

    def joint(self, time_s: Floats) -> tuple[Floats, Floats]:
        """Angle, rad, and velocity, rad/s; zeros where the joint is held still."""
        if self.movement is None:
            return np.zeros_like(time_s), np.zeros_like(time_s)
        frequency, amplitude, phase = self.movement
        turn = 2.0 * np.pi * frequency * time_s[:, None] + phase
        angle = np.pi / 2.0 + np.sin(turn) @ amplitude
        return angle, np.cos(turn) @ (amplitude * 2.0 * np.pi * frequency)

    def fine(self, step_s: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Width, pulse, angle and velocity at every step. Torque at step k depends on widths before k."""
        count = round(self.duration_s / step_s)
        index = np.floor((np.arange(count) - 1) * (step_s * PULSES_PER_S) + 1e-9).astype(int)
        index = np.minimum(index, self.width_us.size - 1)
        width = np.where(index >= 0, self.width_us[np.maximum(index, 0)], 0.0)
        pulse = np.zeros(count)
        pulse[1:] = (np.diff(index) > 0) & (width[1:] > 0.0)
        angle, velocity = self.joint(np.arange(count, dtype=np.float64) * step_s)
        return width, pulse, angle, velocity


def prbs(top: float, bits_held: int, seed: int) -> Floats:
    """Maximal-length sequence of seven bits, between 0 and `top`."""
    register = [(seed >> i) & 1 for i in range(7)]
    if not any(register):
        register[0] = 1
    bits = []
    for _ in range(127):
        bits.append(register[-1])
        register = [register[6] ^ register[5], *register[:-1]]
    return np.repeat(np.array(bits) * top, bits_held)


def triangle(top: float, up_s: float) -> Floats:
    """A slow ramp: up to `top` in so many seconds, and down again."""
    n = round(up_s * PULSES_PER_S)
    up = np.arange(n) / n
    return np.concatenate([up, 1.0 - up]) * top


def levels(rng: Generator, top: float, duration_s: float) -> Floats:
    """Random levels, each held 0.2 to 1 s; one in seven is a rest."""
    n = round(duration_s * PULSES_PER_S)
    out: list[Floats] = []
    while sum(map(len, out)) < n:
        level = 0.0 if rng.random() < 1 / 7 else float(rng.uniform(0.1, 1.0)) * top
        out.append(np.full(int(rng.integers(8, 41)), level))
    return np.concatenate(out)[:n]


def make_design(
    name: str,
    rng: Generator,
    top_us: float,
    *,
    validate_s: float = 16.0,
    with_validate: bool = True,
    moving: bool = False,
) -> Design:
    """A pre-session test.

    `full`: rest 2 s, PRBS 12.7 s, rest 3 s, ramp 5 s up and 5 s down, rest 2 s, multi-level `validate`, rest 2 s.
    `short`: PRBS and ramp only.

    Raises ValueError: no such design.
    """
    if name not in DESIGNS:
        raise ValueError(f"design {name!r}: one of {', '.join(DESIGNS)}")
    rest = lambda seconds: ("rest", np.zeros(round(seconds * PULSES_PER_S)))  # noqa: E731
    bits = ("prbs", prbs(top_us, 4, int(rng.integers(1, 128))))
    ramp = ("ramp", triangle(top_us, 5.0))
    if name == "short":
        parts = [bits, ramp]
    else:
        parts = [rest(2), bits, rest(3), ramp, rest(2)]
        if with_validate:
            parts += [("validate", levels(rng, top_us, validate_s)), rest(2)]
    width = np.asarray(np.round(np.concatenate([w for _, w in parts])), dtype=np.float64)  # stimulators set whole µs
    segment = np.concatenate([np.full(len(w), s, dtype="U12") for s, w in parts])
    movement = None
    if moving:
        count = int(rng.integers(2, 4))
        amplitude = np.deg2rad(rng.uniform(10.0, 22.0, count))
        movement = (rng.uniform(0.03, 0.35, count), amplitude, rng.uniform(0.0, 2.0 * np.pi, count))
    return Design(width, segment, movement)
