"""The muscle without effects: recruitment drawn from many shapes, linear second-order dynamics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.hidden import recruitment
from stimrig.hardware_sim.hidden.kernels import (
    LARGEST_NM,
    PULSE,
    SPEED,
    STEP_S,
    Floats,
    NotSuited,
    Stage,
    helper,
    kernel,
)

PERIOD_S = 0.025
TABLE_SIZE = 512
"""Recruitment is a table with one entry per µs."""


@helper
def look_up(table: Any, width_us: float) -> float:
    """The recruitment table between its entries, N·m."""
    if not width_us > 0.0:
        return table[0]
    if width_us >= 511.0:
        return table[511]
    i = int(width_us)
    return table[i] + (width_us - i) * (table[i + 1] - table[i])


@kernel("recruitment")
def recruit(x, p, s, c):
    """p[0:512]: torque at every µs."""
    return look_up(p, x)


@helper
def second_order_step(w, rate, damping, s, first, step_s):
    """Fourth-order Runge-Kutta step of y'' = rate² (w - y) - 2 damping rate y', state s[first : first + 2]."""
    y, v = s[first], s[first + 1]
    a = rate * rate
    b = 2.0 * damping * rate
    k1 = a * (w - y) - b * v
    v2 = v + 0.5 * step_s * k1
    k2 = a * (w - y - 0.5 * step_s * v) - b * v2
    v3 = v + 0.5 * step_s * k2
    k3 = a * (w - y - 0.5 * step_s * v2) - b * v3
    v4 = v + step_s * k3
    k4 = a * (w - y - step_s * v3) - b * v4
    s[first] = y + step_s / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
    s[first + 1] = v + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return s[first]


@helper
def lag_after(before, after, state, tau_s, step_s):
    """A first-order lag whose input goes from `before` to `after` over the step: its state at the end."""
    return state + (0.5 * (before + after) - state) * (1.0 - math.exp(-step_s / tau_s))


@helper
def force_after(before, s, tau_s, c):
    """The force s[1], N·m, a lag behind calcium, which went from `before` to s[0] over the step."""
    s[1] = lag_after(before * c[LARGEST_NM], s[0] * c[LARGEST_NM], s[1], tau_s, c[STEP_S])
    return s[1]


@helper
def delayed(x, late, s, first, size):
    """`x` of `late` steps ago, linear between steps, by a ring s[first : first + size] whose place is s[0]."""
    i = int(s[0])
    s[first + i] = x
    s[0] = (i + 1) % size
    whole = int(late)
    a = s[first + (i - whole) % size]
    b = s[first + (i - whole - 1) % size]
    return a + (late - whole) * (b - a)


@kernel("dynamics")
def second_order(x, p, s, c):
    """p: 1/Tω, ζ."""
    return second_order_step(x, p[0] * c[SPEED], p[1], s, 0, c[STEP_S])


@kernel("delay")
def as_pulses(x, p, s, c):
    """p: length of a pulse's drive s, latency s, period s. s[0]: place in a ring, then drives to come.

    The recruited torque of a period comes in one short burst per pulse, centred in the period.
    """
    size = 256
    i = int(s[0])
    s[0] = (i + 1) % size
    if c[PULSE] > 0.0:
        first = p[1] / c[STEP_S]
        last = first + p[0] / c[STEP_S]
        for k in range(int(first), int(last) + 1):
            part = min(k + 1.0, last) - max(float(k), first)
            s[1 + (i + k) % size] += x * part * p[2] / p[0]
    out = s[1 + i]
    s[1 + i] = 0.0
    return out


@dataclass(frozen=True)
class Base:
    """A muscle without effects.

    `lags_s` are the two time constants where the dynamics are two first-order lags in a row, else None. Where
    `burst_s` is not 0, each pulse drives the muscle in a burst of that length, so that torque ripples at 40 Hz.
    """

    shape: str
    table_nm: Floats
    largest_width_us: int
    t_omega_s: float
    zeta: float
    lags_s: tuple[float, float] | None
    dynamics: str
    numbers: dict[str, float]
    burst_s: float = 0.0

    @property
    def largest_nm(self) -> float:
        """Steady torque at the largest pulse width."""
        return float(self.table_nm[self.largest_width_us])

    def rise_us(self) -> tuple[float, float]:
        """Pulse widths at 10 and 90 % of the largest torque."""
        share = np.maximum.accumulate(self.table_nm) / self.largest_nm
        return float(np.argmax(share >= 0.1)), float(np.argmax(share >= 0.9))

    def two_lags_s(self) -> tuple[float, float]:
        """The two time constants, the shorter first. Raises NotSuited: the dynamics are not two first-order lags."""
        if self.lags_s is None:
            raise NotSuited("needs two real time constants")
        return min(self.lags_s), max(self.lags_s)

    def stages(self) -> list[Stage]:
        """Recruitment and dynamics."""
        stages = [
            Stage(recruit, self.table_nm),
            Stage(second_order, (1.0 / self.t_omega_s, self.zeta)),
        ]
        if self.burst_s > 0.0:
            stages.append(Stage(as_pulses, (self.burst_s, 0.5 * (PERIOD_S - self.burst_s), PERIOD_S)))
        return stages

    def describe(self) -> dict[str, Any]:
        """Return its entry in `reveal`."""
        return {
            "recruitment": self.shape,
            "dynamics": self.dynamics,
            "largest_torque_nm": round(self.largest_nm, 4),
            "largest_width_us": self.largest_width_us,
            "rise_10_90_us": list(self.rise_us()),
            "t_omega_s": round(self.t_omega_s, 5),
            "zeta": round(self.zeta, 5),
            "burst_s": self.burst_s,
            **self.numbers,
        }


def _draw_dynamics(rng: Generator) -> tuple[str, float, float, tuple[float, float] | None]:
    kind = str(rng.choice(["second order", "two lags", "calcium then force"], p=[0.5, 0.3, 0.2]))
    if kind == "second order":
        return kind, float(np.exp(rng.uniform(np.log(0.1), np.log(0.6)))), float(rng.uniform(0.6, 1.2)), None
    if kind == "two lags":
        first = float(np.exp(rng.uniform(np.log(0.08), np.log(0.45))))
        second = first * float(rng.uniform(0.5, 1.0))
    else:
        first, second = float(rng.uniform(0.02, 0.08)), float(np.exp(rng.uniform(np.log(0.12), np.log(0.5))))
    t_omega = float(np.sqrt(first * second))
    return kind, t_omega, (first + second) / (2.0 * t_omega), (first, second)


def draw_base(rng: Generator, steep: bool = False) -> Base:
    """Draw a muscle; `steep` asks for recruitment that rises (10 to 90 %) within 5 to 25 µs."""
    shape, share, numbers, largest_width_us = recruitment.draw(rng, steep, TABLE_SIZE)
    gain_nm = float(np.exp(rng.uniform(np.log(3.0), np.log(15.0))))
    table = np.ascontiguousarray(share / share[largest_width_us] * gain_nm)
    dynamics, t_omega, zeta, lags = _draw_dynamics(rng)
    return Base(shape, table, largest_width_us, t_omega, zeta, lags, dynamics, numbers)
