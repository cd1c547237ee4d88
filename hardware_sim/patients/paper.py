"""The paper's muscle (Le, Markovsky, Freeman, Rogers, section V): sigmoid, then 2nd-order dynamics.

f(u) = a1 (exp(a2 u) - 1) / (exp(a2 u) + a3), eq. (35), and G: T² y'' + 2 ζ T y' + y = f, unit gain at DC.

The paper's input is a continuous pulse width, but a muscle gets pulses. A pulse's recruitment is therefore held for one
pulse period. Jitter of the pulses must leave no gap, and a missing pulse must leave one; no causal rule does both. So
when a hold ends, the state there is saved and the torque goes on without input. If a pulse comes within `late_periods`
of the one before, the time since is integrated again with the hold extended to it. Readings taken in between are off by
w dt² / (2 T²): 1e-5 N·m for a pulse 1 ms late.

The paper gives f at one current. At another the width is scaled by charge: width × current / nominal current.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Parameters:
    """Parameters of section V; T in seconds (the paper's T_omega), torque in N·m, widths in µs."""

    a1: float = 6.8994
    a2: float = 0.0410
    a3: float = 2.3897e3
    natural_period_s: float = 0.5284
    damping_ratio: float = 0.6369
    nominal_current_ma: float = 20.0
    pulse_period_s: float = 0.025
    late_periods: float = 1.2


class PaperMuscle:
    """Section V's muscle, driven by single pulses; exact between them (closed-form matrix exponential)."""

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.parameters = p = parameters or Parameters()
        self._omega2 = 1.0 / p.natural_period_s**2
        self._sigma = p.damping_ratio / p.natural_period_s
        self._discriminant = (1.0 - p.damping_ratio**2) * self._omega2
        self._time_s = 0.0
        self._y = self._dy = 0.0
        self._held_nm = 0.0
        self._hold_end_s = -math.inf
        self._at_hold_end: tuple[float, float] | None = None

    def recruitment_nm(self, width_us: float, current_ma: float) -> float:
        """Steady torque of a train of such pulses, N·m; eq. (35)."""
        p = self.parameters
        exponent = p.a2 * width_us * current_ma / p.nominal_current_ma
        if exponent <= 0.0:
            return 0.0
        decay = math.exp(-exponent)  # divided through by exp(a2 u): no overflow at 4095 µs
        return p.a1 * (1.0 - decay) / (1.0 + p.a3 * decay)

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        p = self.parameters
        longest_hold_s = (p.late_periods - 1.0) * p.pulse_period_s
        self._advance(time_s)
        if self._at_hold_end is not None and time_s - self._hold_end_s <= longest_hold_s:
            self._y, self._dy = self._at_hold_end
            self._time_s = self._hold_end_s
            self._step_to(time_s, self._held_nm)
        self._held_nm = self.recruitment_nm(width_us, current_ma)
        self._hold_end_s = time_s + p.pulse_period_s
        self._at_hold_end = None

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the elbow torque there, N·m."""
        self._advance(time_s)
        return self._y

    def _advance(self, time_s: float) -> None:
        if self._time_s < self._hold_end_s:
            if time_s < self._hold_end_s:
                self._step_to(time_s, self._held_nm)
                return
            self._step_to(self._hold_end_s, self._held_nm)
            self._at_hold_end = (self._y, self._dy)
        self._step_to(time_s, 0.0)

    def _step_to(self, time_s: float, input_nm: float) -> None:
        """Exact solution over the step for a constant input."""
        dt = time_s - self._time_s
        if dt <= 0.0:
            return
        decay = math.exp(-self._sigma * dt)
        c, s = _oscillation(self._discriminant, dt)
        offset, rate = self._y - input_nm, self._dy
        self._y = input_nm + decay * (offset * (c + self._sigma * s) + rate * s)
        self._dy = decay * (rate * (c - self._sigma * s) - offset * self._omega2 * s)
        self._time_s = time_s


def _oscillation(discriminant: float, dt: float) -> tuple[float, float]:
    """cos(w dt) and sin(w dt) / w for w² = `discriminant`, also where it is zero or negative."""
    if discriminant > 0.0:
        w = math.sqrt(discriminant)
        return math.cos(w * dt), math.sin(w * dt) / w
    if discriminant < 0.0:
        w = math.sqrt(-discriminant)
        return math.cosh(w * dt), math.sinh(w * dt) / w
    return 1.0, dt


def make(parameters: Parameters) -> PaperMuscle:
    """The muscle with these parameters, at rest."""
    return PaperMuscle(parameters)
