"""Drift of the zero: the load cell warms up, the limb settles, an offset changes."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Columns, Effect, Parameter, Scene, Values, basis

KNOTS = 6


def _shift(name: str, reach: float, about: str = "", start: float = 0.0, unit: str = "N·m") -> Parameter:
    """A parameter in multiples of the largest torque, as likely up as down."""
    return Parameter(name, unit, -reach, reach, 0.0, (start,), relative="torque", about=about)


@basis("y + slope·t", _shift("slope_nm_per_s", 0.04, "drift per second", unit="N·m/s"))
def linear(_p: Values, scene: Scene) -> Columns:
    return {"slope_nm_per_s": scene.time_s}


@basis(
    "y + shift (1 - exp(-t/time_constant))",
    _shift("shift_nm", 0.6, "final shift"),
    Parameter("time_constant_s", "s", 2.0, 80.0, 15.0, (5.0, 20.0), "log", about="time constant of the shift"),
)
def warming(p: Values, scene: Scene) -> Columns:
    return {"shift_nm": -np.expm1(-scene.time_s / p["time_constant_s"])}


_KNOTS = tuple(_shift(f"knot_{i}_nm", 0.3, f"shift at {i}/{KNOTS} of the record") for i in range(1, KNOTS + 1))


@basis("y + s(t), s: a natural cubic spline with six knots over the record", *_KNOTS)
def wander(_p: Values, scene: Scene) -> Columns:
    """Evenly spaced knots, zero at the start."""
    from scipy.interpolate import CubicSpline  # here: its import takes longer than a fit, which does not need it

    spline = CubicSpline(np.linspace(0.0, 1.0, KNOTS + 1), np.eye(KNOTS + 1)[:, 1:], bc_type="natural")
    return dict(zip((knot.name for knot in _KNOTS), spline(scene.share_of_span).T, strict=True))


EFFECT = Effect(
    id="baseline_drift",
    name="Drift of the baseline",
    forms=(linear, warming, wander),
    signature="The rests do not return to the same torque; the error does not depend on the stimulation.",
    resembles=("voluntary_effort", "fatigue", "mixed_fibres", "passive_torque"),
    separated_by="Rests at zero pulse width before and after each part.",
    plain="The zero of the measurement drifts; the muscle is not the cause. Let the load cell warm up, support the "
    "limb, and set the zero again.",
    source="Warm-up of load cells, settling of the limb",
    predictable=False,
    muscle=False,
    main={"slope_nm_per_s": "slope", "shift_nm": "shift", "knot_1_nm": "first shift"},
)
