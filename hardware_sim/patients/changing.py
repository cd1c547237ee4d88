"""A muscle that changes over a session: it tires, warms up, slows; its threshold drifts; it cramps, or its owner helps.

Recruitment is the share of nerve fibres whose threshold a pulse exceeds, with Weibull-distributed thresholds:
f(u) = F (1 - exp(-((u - θ) / λ)^k)) above θ; then 2nd-order dynamics (`HeldPulses`). Widths are scaled by charge. All
changes are in use or time:

- A *store* s fills with use and empties at rest: s' = r v (1 - s) - s / τ (after Riener's fatigue, 1996). A fibre tires
  by the pulses that excite it, and those of low threshold are excited by most. So v = a (1 + h) / (a + h), a = f / F
  and h = 0.15, grows less than recruitment does. r is chosen so that the usual session, ten contractions of 12 s at a
  third of F with rests of 15 s, leaves the wanted share at its end. Fatigue: gain · (1 - s). Potentiation:
  gain · (1 + s). Slowing: T · (1 + s).
- The threshold moves by D (1 - exp(-t / τ)), t since the first pulse: an electrode that settles like an RC.
- In one contraction, a spasm (a steep burst) or an effort (a slow bump) is added to the torque. A contraction begins
  with the first pulse after a pause of 5 s. The test before a session is the first.

At every default the muscle does not change. Gain, threshold and T are those at a pulse, and hold until the next one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stimrig.hardware_sim.errors import HardwareSimError
from stimrig.hardware_sim.patients.muscle import NOMINAL_CURRENT_MA, HeldPulses

PAUSE_S = 5.0
"""A pause as long begins a new contraction."""
HALF_USE = 0.15
SESSION, CONTRACTION_S, REST_S, SHARE = 10, 12.0, 15.0, 1.0 / 3.0
"""The usual session: contractions, their length, the rests between them, share of the fibres recruited."""


@dataclass(frozen=True)
class Parameters:
    """Torque in N·m, widths in µs; shares are those at the end of the usual session; contraction 0 is none."""

    largest_nm: float = 7.0
    threshold_us: float = 70.0
    spread_us: float = 110.0
    shape: float = 2.0
    natural_period_s: float = 0.25
    damping_ratio: float = 0.8
    fatigue_share: float = 0.0
    fatigue_recovery_s: float = 200.0
    potentiation_share: float = 0.0
    potentiation_recovery_s: float = 60.0
    slowing_share: float = 0.0
    slowing_recovery_s: float = 300.0
    drift_us: float = 0.0
    drift_settling_s: float = 150.0
    spasm_contraction: float = 0.0
    spasm_nm: float = 3.0
    spasm_begins_s: float = 4.0
    spasm_lasts_s: float = 0.8
    effort_contraction: float = 0.0
    effort_nm: float = 1.5
    effort_begins_s: float = 3.0
    effort_lasts_s: float = 4.0


class Store:
    """Fills with use and empties at rest; `share` after the usual session, negative for the opposite effect."""

    def __init__(self, share: float, recovery_s: float) -> None:
        self._sign, self._empties_per_s = math.copysign(1.0, share), 1.0 / recovery_s
        self._fills_per_s = _rate(abs(share), recovery_s)
        self.level = 0.0

    @property
    def value(self) -> float:
        """The share as it is now."""
        return self._sign * self.level

    def step(self, dt: float, use: float) -> None:
        """Exact for a constant use."""
        if self._fills_per_s > 0.0:
            self.level = _filled(self.level, dt, self._fills_per_s * use, self._empties_per_s)


def _filled(level: float, dt: float, fills_per_s: float, empties_per_s: float) -> float:
    both = fills_per_s + empties_per_s
    settled = fills_per_s / both
    return settled + (level - settled) * math.exp(-both * dt)


def _rate(share: float, recovery_s: float) -> float:
    """The rate r at which the usual session ends with this share, per s, by bisection."""

    def after_session(rate: float) -> float:
        level = 0.0
        for _ in range(SESSION):
            level = _filled(level * math.exp(-REST_S / recovery_s), CONTRACTION_S, rate * _use(SHARE), 1.0 / recovery_s)
        return level

    if share == 0.0:
        return 0.0
    if not share < 1.0:
        raise HardwareSimError(f"a share must lie between -1 and 1, not at {share:g}")
    low, high = 0.0, 1.0
    while after_session(high) < share:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if after_session(middle) < share else (low, middle)
    return high


def _use(recruited: float) -> float:
    return recruited * (1.0 + HALF_USE) / (recruited + HALF_USE)


class ChangingMuscle(HeldPulses):
    """The muscle, driven by single pulses; its gain, threshold and speed at any time are attributes."""

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.parameters = p = parameters or Parameters()
        super().__init__(p.natural_period_s, p.damping_ratio)
        self._fatigue = Store(p.fatigue_share, p.fatigue_recovery_s)
        self._potentiation = Store(p.potentiation_share, p.potentiation_recovery_s)
        self._slowing = Store(p.slowing_share, p.slowing_recovery_s)
        self._stores = self._fatigue, self._potentiation, self._slowing
        self._recruited = 0.0
        self._first_pulse_s, self._last_pulse_s = math.inf, -math.inf
        self._begun_s = 0.0
        self.contractions = 0

    @property
    def gain(self) -> float:
        """Factor on the recruitment now."""
        return (1.0 - self._fatigue.value) * (1.0 + self._potentiation.value)

    @property
    def time_scale(self) -> float:
        """Factor on the natural period now."""
        return 1.0 + self._slowing.value

    def shift_us(self, time_s: float) -> float:
        """Return the threshold's shift, µs."""
        since_s = max(time_s - self._first_pulse_s, 0.0)
        return -self.parameters.drift_us * math.expm1(-since_s / self.parameters.drift_settling_s)

    def drive_nm(self, time_s: float, width_us: float, current_ma: float) -> float:
        """Steady torque of a train of such pulses by the muscle as it is now, N·m."""
        p = self.parameters
        if time_s - self._last_pulse_s >= PAUSE_S:
            self.contractions += 1
            self._begun_s = time_s
        self._first_pulse_s = min(self._first_pulse_s, time_s)
        self._last_pulse_s = time_s
        if p.slowing_share:
            self._set_period(p.natural_period_s * self.time_scale)
        above_us = width_us * current_ma / NOMINAL_CURRENT_MA - p.threshold_us - self.shift_us(time_s)
        self._recruited = -math.expm1(-((above_us / p.spread_us) ** p.shape)) if above_us > 0.0 else 0.0
        return p.largest_nm * self.gain * self._recruited

    def torque_nm(self, time_s: float) -> float:
        """Advance to `time_s` and give the elbow torque there, N·m."""
        p, torque_nm, since_s = self.parameters, super().torque_nm(time_s), time_s - self._begun_s
        if self.contractions and self.contractions == p.spasm_contraction:
            torque_nm += p.spasm_nm * _burst((since_s - p.spasm_begins_s) / p.spasm_lasts_s)
        if self.contractions and self.contractions == p.effort_contraction:
            torque_nm += p.effort_nm * _bump((since_s - p.effort_begins_s) / p.effort_lasts_s)
        return torque_nm

    def _state(self) -> tuple[float, ...]:
        return (self._y, self._dy, *(store.level for store in self._stores))

    def _return_to(self, state: tuple[float, ...]) -> None:
        self._y, self._dy, *levels = state
        for store, level in zip(self._stores, levels, strict=True):
            store.level = level

    def _step_to(self, time_s: float, input_nm: float) -> None:
        dt, use = max(time_s - self._time_s, 0.0), _use(self._recruited) if input_nm else 0.0
        for store in self._stores:
            store.step(dt, use)
        super()._step_to(time_s, input_nm)


def _burst(share: float) -> float:
    """0 to 1 within the first tenth of its time, 1, and back within the last three tenths."""
    return _smooth(min(share / 0.1, 1.0, (1.0 - share) / 0.3))


def _bump(share: float) -> float:
    """0 to 1 in its middle and back, without a corner."""
    return _smooth(1.0 - abs(2.0 * share - 1.0))


def _smooth(level: float) -> float:
    return math.sin(0.5 * math.pi * level) ** 2 if level > 0.0 else 0.0
