"""Drift of the recruitment threshold: electrode and skin impedance change during the test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_TIME = Parameter("time_constant_s", "s", 5.0, 90.0, 15.0, (10.0,), "log", about="time constant of the shift")
_SLOPE = Parameter("slope_us_per_s", "µs/s", -4.0, 4.0, 0.0, (0.5, -0.5), about="shift of the threshold per second")
_SHIFT = Parameter("shift_us", "µs", -80.0, 80.0, 0.0, (15.0, -15.0), about="final shift")
_SHARE = Parameter("share", "1", -0.7, 0.7, 0.0, (0.1, -0.1), about="share of the width lost in the end")


def _moved(width: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return np.where(width > 0, width - shift, width)


def _settled(p: Values, scene: Scene) -> np.ndarray:
    """1 - exp(-t/time_constant), minus its value at the reference time, at which the recruitment curve holds."""
    tau = p["time_constant_s"]
    return np.exp(-scene.reference_s / tau) - np.exp(-scene.time_s / tau)


@form("pulse_width", "w = f(u - slope·t) where u > 0", _SLOPE)
def linear(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _moved(width, p["slope_us_per_s"] * scene.time_s)


@form(
    "pulse_width",
    "w = f(u - shift (exp(-t_ref/time_constant) - exp(-t/time_constant))) where u > 0; t_ref: middle of the ramp",
    _SHIFT,
    _TIME,
)
def settling(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _moved(width, p["shift_us"] * _settled(p, scene))


@form(
    "pulse_width",
    "w = f(u (1 - share (exp(-t_ref/time_constant) - exp(-t/time_constant))))",
    _SHARE,
    replace(_TIME, start=(12.0,)),
    source="Lapicque: widths at threshold scale as the current falls",
)
def fading(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return width * (1.0 - p["share"] * _settled(p, scene))


EFFECT = Effect(
    id="threshold_drift",
    name="Drift of the recruitment threshold",
    forms=(linear, settling, fading),
    signature="The recruitment curve moves along the pulse width: the error is large where it is steep, and grows "
    "with time.",
    resembles=("fatigue", "potentiation", "voluntary_effort", "recruitment_hysteresis"),
    separated_by="The ramp repeated at the end; the impedance of the electrodes.",
    plain="The pulse width at which the muscle begins to respond changes during the session: the gel dries, the skin "
    "warms, or an electrode moves. Weak pulses change most, strong ones hardly. Check the electrodes.",
    source="Electrode and skin impedance; no single source, see docs/diagnosis.md",
    prior=-2.5,
    main={"slope_us_per_s": "slope", "shift_us": "shift", "share": "share"},
)
