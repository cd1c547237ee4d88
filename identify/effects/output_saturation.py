"""Saturation after the dynamics: tendon, joint stop or fixture limit the torque."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_CEILING = Parameter("ceiling_nm", "N·m", 0.4, 4.0, np.inf, (1.2, 2.0), "log", "torque", "largest possible torque")
_SHARP = Parameter("sharpness", "1", 1.6, 25.0, 4.0, (4.0, 8.0), "log", about="n, sharpness of the knee")


@form("output", "y/(1 + |y/ceiling|^n)^(1/n)", _CEILING, _SHARP)
def knee(y: np.ndarray, p: Values, _scene: Scene) -> np.ndarray:
    return y / (1.0 + np.abs(y / p["ceiling_nm"]) ** p["sharpness"]) ** (1.0 / p["sharpness"])


@form("output", "ceiling (1 - exp(-y/ceiling))", _CEILING)
def exponential(y: np.ndarray, p: Values, _scene: Scene) -> np.ndarray:
    c = p["ceiling_nm"]
    with np.errstate(invalid="ignore"):
        bent = np.sign(y) * c * -np.expm1(-np.abs(y) / c)
    return np.where(np.isinf(c), y, bent)


@form(
    "output",
    "y - yield·max(y - knee, 0), with a smooth corner",
    Parameter("knee_nm", "N·m", 0.2, 1.1, 0.8, (0.6, 0.8), "log", "torque", "where it begins to yield"),
    Parameter("yield_share", "1", 0.0, 1.0, 0.0, (0.5, 0.8), about="share lost above the knee"),
    Parameter("corner", "1", 0.005, 0.4, 0.05, (0.05, 0.15), "log", about="softness, share of full torque"),
)
def yielding(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    width = p["corner"] * scene.scale_nm
    over, rest = np.abs(y) - p["knee_nm"], -p["knee_nm"]
    # A smooth corner, exactly zero at zero torque.
    soft = 0.5 * (over + np.sqrt(over * over + width * width)) - 0.5 * (rest + np.sqrt(rest * rest + width * width))
    return y - np.sign(y) * p["yield_share"] * soft


EFFECT = Effect(
    id="output_saturation",
    name="Saturation of the output",
    forms=(knee, exponential, yielding),
    signature="High torques are cut off, whether they are reached fast or slowly.",
    resembles=("asymmetric_relaxation", "sensor_clipping", "activation_dependent_speed"),
    separated_by="The plateaus of a staircase, reached from below and from above.",
    plain="Above some torque the limb or the fixture gives way: the muscle pulls harder, but the load cell does not "
    "show it.",
    source="Soft knee of tendon and compliance after the dynamics (Wiener structure)",
    main={"ceiling_nm": "ceiling", "knee_nm": "knee"},
)
