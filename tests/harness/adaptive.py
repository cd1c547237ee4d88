"""Patients of many shapes for adaptive tests, and the loop that plays one, without a rig or a worker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from stimrig.hardware_sim.hidden import recruitment
from stimrig.identify.experiments.adaptive import AdaptiveGoal, Decision, Target, decide
from stimrig.identify.records.record import Record
from tests.harness.muscle import FINE_HZ, Patient, second_order, torque_after
from tests.harness.patients import as_record

PULSE_RATE_HZ = 40.0


@dataclass(frozen=True)
class Muscle:
    """A muscle with a tabulated curve, of plain structure."""

    name: str
    table_nm: np.ndarray
    top_us: float
    time_constant_s: float
    damping: float
    delay_s: float

    def curve(self, width_us: np.ndarray | float) -> np.ndarray:
        """Steady torque, N·m."""
        return np.interp(width_us, np.arange(self.table_nm.size), self.table_nm)

    def step(self, time_s: np.ndarray) -> np.ndarray:
        """Response to a unit step."""
        size = int((time_s[-1] + 0.1) * FINE_HZ)
        response = second_order(np.ones(size), self.time_constant_s, self.damping, FINE_HZ)
        return np.interp(time_s - self.delay_s, np.arange(size) / FINE_HZ, response, left=0.0)

    def torque(self, widths_us: np.ndarray, rate_hz: float) -> np.ndarray:
        """Clean torque at the samples, N·m."""
        return torque_after(self.curve(widths_us), rate_hz, self.time_constant_s, self.damping, self.delay_s)

    def another_day(self, rng: np.random.Generator) -> Muscle:
        """The same muscle in another session: gain, threshold, width of the rise and speed have changed."""
        u = np.arange(self.table_nm.size, dtype=float)
        half = float(np.argmax(self.table_nm >= 0.5 * self.table_nm.max()))
        shift, widen = rng.normal(0.0, 8.0), float(np.exp(rng.normal(0.0, 0.08)))
        table = np.interp(half + (u - half - shift) / widen, u, self.table_nm)
        table = (table - table[0]) * float(np.exp(rng.normal(0.0, 0.2)))
        t, z = self.time_constant_s * np.exp(rng.normal(0.0, 0.08)), self.damping * np.exp(rng.normal(0.0, 0.06))
        return replace(self, table_nm=table, time_constant_s=float(t), damping=float(z))


def sigmoid(seed: int) -> Muscle:
    """The paper's kind of curve: gain 1.5-15 N·m, rise 10-150 µs, T 0.1-0.6 s, damping 0.6-1.2."""
    rng = np.random.default_rng([seed, 131])
    dynamics = _dynamics(rng)
    return Muscle("sigmoid", Patient.draw(rng).recruitment(np.arange(512.0)), 300.0, *dynamics)


def shaped(seed: int) -> Muscle:
    """One of the emulator's eight shapes, most of them no sigmoids."""
    rng = np.random.default_rng([seed, 132])
    gain, dynamics = float(rng.uniform(1.5, 15.0)), _dynamics(rng)
    name, share, _, largest = recruitment.draw(rng, False, 512)
    return Muscle(name, gain * share / share[largest], float(largest), *dynamics)


def _dynamics(rng: np.random.Generator) -> tuple[float, float, float]:
    return float(rng.uniform(0.1, 0.6)), float(rng.uniform(0.6, 1.2)), float(rng.uniform(0.0, 0.002))


def recorded(
    muscle: Any, widths_us: np.ndarray, names: list[str], noise_nm: np.ndarray, rate_hz: float = 400.0
) -> Record:
    """The record of a muscle; `noise_nm` holds at least as many samples as the record."""
    clean = muscle.torque(widths_us, rate_hz)
    return as_record(clean + noise_nm[: clean.size], widths_us, rate_hz, names)


@dataclass
class Played:
    """A test as it was played."""

    decision: Decision
    widths_us: np.ndarray
    names: list[str]
    record: Record | None
    decisions: list[Decision] = field(default_factory=list)

    def dose_nm_s(self, muscle: Any) -> float:
        """Torque-time by the muscle's own curve, N·m·s."""
        return float(np.sum(muscle.curve(self.widths_us))) / PULSE_RATE_HZ

    @property
    def seconds(self) -> float:
        return self.widths_us.size / PULSE_RATE_HZ


def play(
    muscle: Any,
    noise_nm: np.ndarray,
    target: Target,
    *,
    left_s: float,
    left_nm_s: float,
    rate_hz: float = 400.0,
    timed: Callable[[Callable[[], Decision]], Decision] = lambda call: call(),
    **known: Any,
) -> Played:
    """Play an adaptive test to its end."""
    made = Played(Decision("next"), np.zeros(0), [], None)
    while True:
        before = made.decisions[-1] if made.decisions else None
        left = {"left_s": max(left_s - made.seconds, 0.0), "left_nm_s": max(left_nm_s - made.dose_nm_s(muscle), 0.0)}
        asked = AdaptiveGoal(target, **left, largest_us=muscle.top_us, **known)
        made.decision = timed(partial(decide, made.record, made.widths_us, asked, before))
        made.decisions.append(made.decision)
        if made.decision.kind != "next":
            return made
        for segment in made.decision.segments:
            widths = np.array(segment.settings["pulse_width_us"])
            made.widths_us = np.r_[made.widths_us, widths]
            made.names += [segment.name] * widths.size
        made.record = recorded(muscle, made.widths_us, made.names, noise_nm, rate_hz)
