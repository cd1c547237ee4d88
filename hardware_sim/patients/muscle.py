"""Protocol of emulated muscles, and the base of those with second-order dynamics."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Protocol

NOMINAL_CURRENT_MA = 20.0
PULSE_PERIOD_S, LATE_PERIODS = 0.025, 1.2


class Muscle(Protocol):
    """A muscle with its joint held still, stimulated by single pulses.

    Time is the emulator's own, in seconds, and never runs backwards.
    """

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        ...

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the elbow torque there, N·m, without the sensor's noise."""
        ...


class HeldPulses:
    """Second-order dynamics behind pulses whose recruitment is held, exact whenever it is read (matrix exponential).

    G: T² y'' + 2 ζ T y' + y = w, unit gain at DC. A pulse's recruitment w is held for one pulse period. Jitter of the
    pulses must leave no gap, and a missing pulse must leave one; no causal rule does both. So when a hold ends, the
    state there is saved and the torque goes on without input. If a pulse comes within `LATE_PERIODS` of the one before,
    the time since is integrated again with the hold extended to it. Readings taken in between are off by w dt² / (2
    T²): 1e-5 N·m for a pulse 1 ms late.

    A patient overrides `drive_nm`; one with further states `_state`, `_return_to` and `_step_to`.
    """

    def __init__(self, natural_period_s: float, damping_ratio: float) -> None:
        self._damping_ratio = damping_ratio
        self._set_period(natural_period_s)
        self._time_s = 0.0
        self._y = self._dy = 0.0
        self._held_nm = 0.0
        self._hold_end_s = -math.inf
        self._at_hold_end: Any = None

    def drive_nm(self, time_s: float, width_us: float, current_ma: float) -> float:
        """Steady torque of a train of such pulses, N·m, of a pulse that arrives now."""
        raise NotImplementedError

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """A pulse of `width_us` a phase and `current_ma` reaches the electrodes at `time_s`."""
        self._advance(time_s)
        if self._at_hold_end is not None and time_s - self._hold_end_s <= (LATE_PERIODS - 1.0) * PULSE_PERIOD_S:
            self._return_to(self._at_hold_end)
            self._time_s = self._hold_end_s
            self._step_to(time_s, self._held_nm)
        self._held_nm = self.drive_nm(time_s, width_us, current_ma)
        self._hold_end_s = time_s + PULSE_PERIOD_S
        self._at_hold_end = None

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the elbow torque there, N·m."""
        self._advance(time_s)
        return self._y

    def _set_period(self, natural_period_s: float) -> None:
        self._omega2 = 1.0 / natural_period_s**2
        self._sigma = self._damping_ratio / natural_period_s
        self._discriminant = (1.0 - self._damping_ratio**2) * self._omega2

    def _state(self) -> Any:
        """The state, for `_return_to`."""
        return self._y, self._dy

    def _return_to(self, state: Any) -> None:
        self._y, self._dy = state

    def _advance(self, time_s: float) -> None:
        if self._time_s < self._hold_end_s:
            if time_s < self._hold_end_s:
                self._step_to(time_s, self._held_nm)
                return
            self._step_to(self._hold_end_s, self._held_nm)
            self._at_hold_end = self._state()
        self._step_to(time_s, 0.0)

    def _step_to(self, time_s: float, input_nm: float) -> None:
        """Exact solution over the step for a constant input."""
        dt = time_s - self._time_s
        if dt <= 0.0:
            return
        y_y, y_dy, dy_y, dy_dy = _transition(self._sigma, self._omega2, self._discriminant, dt)
        offset, rate = self._y - input_nm, self._dy
        self._y = input_nm + y_y * offset + y_dy * rate
        self._dy = dy_y * offset + dy_dy * rate
        self._time_s = time_s


@lru_cache(maxsize=256)
def _transition(sigma: float, omega2: float, discriminant: float, dt: float) -> tuple[float, float, float, float]:
    """The matrix exponential over `dt`, row by row; a sampled muscle asks for the same few steps again and again."""
    decay, w = math.exp(-sigma * dt), math.sqrt(abs(discriminant))
    c, s = 1.0, dt  # cos(w dt) and sin(w dt) / w, also where the square of w is zero or negative
    if discriminant > 0.0:
        c, s = math.cos(w * dt), math.sin(w * dt) / w
    elif discriminant < 0.0:
        c, s = math.cosh(w * dt), math.sinh(w * dt) / w
    return decay * (c + sigma * s), decay * s, -decay * omega2 * s, decay * (c - sigma * s)
