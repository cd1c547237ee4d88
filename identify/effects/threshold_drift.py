"""Drift of the recruitment threshold: electrode and skin impedance change during the test."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene


def _linear(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return np.where(width > 0, width - p["slope_us_per_s"] * scene.time_s, width)


def _settling(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return np.where(width > 0, width - p["shift_us"] * (1.0 - np.exp(-scene.time_s / p["time_constant_s"])), width)


def _scaling(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return width * (1.0 - p["slope_per_s"] * scene.time_s)


def _fading(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return width * (1.0 + p["share"] * np.expm1(-scene.time_s / p["time_constant_s"]))


def _charge(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    used = np.cumsum(scene.pulse_width_us) * scene.step_s / scene.largest_us
    return np.where(width > 0, width - p["slope_us_per_s"] * used, width)


_SLOPE = Parameter("slope_us_per_s", "µs/s", -4.0, 4.0, 0.0, (0.5, -0.5), about="shift of the threshold in a second")

EFFECT = Effect(
    id="threshold_drift",
    name="Drift of the recruitment threshold",
    forms=(
        Form("linear", "pulse_width", "w = f(u - slope·t) where u > 0", (_SLOPE,), _linear, True),
        Form(
            "settling",
            "pulse_width",
            "w = f(u - shift (1 - exp(-t/time_constant))) where u > 0",
            (
                Parameter("shift_us", "µs", -80.0, 80.0, 0.0, (15.0, -15.0), about="final shift"),
                Parameter("time_constant_s", "s", 3.0, 90.0, 15.0, (10.0,), "log", about="how fast it settles"),
            ),
            _settling,
            True,
        ),
        Form(
            "scaling",
            "pulse_width",
            "w = f(u (1 - slope·t))",
            (Parameter("slope_per_s", "1/s", -0.02, 0.02, 0.0, (0.003, -0.003), about="share lost in a second"),),
            _scaling,
            True,
        ),
        Form(
            "fading",
            "pulse_width",
            "w = f(u (1 - share (1 - exp(-t/time_constant))))",
            (
                Parameter("share", "1", -0.7, 0.7, 0.0, (0.1, -0.1), about="share lost in the end"),
                Parameter("time_constant_s", "s", 3.0, 90.0, 15.0, (12.0,), "log", about="how fast it settles"),
            ),
            _fading,
            True,
            source="Lapicque: widths at threshold scale as the current falls",
        ),
        Form(
            "by_charge",
            "pulse_width",
            "w = f(u - slope·∫u dt/u_max) where u > 0",
            (_SLOPE,),
            _charge,
            True,
        ),
    ),
    signature="The curve moves along the pulse width: torque errs where the curve is steep, and more so later.",
    resembles=("fatigue", "potentiation", "voluntary_effort", "recruitment_hysteresis"),
    separated_by="Repeat the ramp at the end; log the electrodes' impedance.",
    plain="The pulse width at which the muscle begins to answer moves during the session, as gel dries, skin warms or an "
    "electrode shifts. Strong pulses look unchanged, weak ones are lost. Check the electrodes.",
    source="Electrode and skin impedance; no single source, see docs/diagnosis.md",
    experiment=("ramp", "rest"),
)
