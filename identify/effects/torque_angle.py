"""Dependence of the active torque on the joint's angle."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form, weighted

_PARABOLA = (
    Parameter("slope_per_rad", "1/rad", -4.0, 4.0, 0.0, (0.3, -0.3), about="slope at the reference angle"),
    Parameter("bend_per_rad2", "1/rad²", -6.0, 6.0, 0.0, (0.0,), about="curvature"),
)
SIZES = (1.5, 1.5, 1.0, 1.0, 0.7, 0.5, 0.4, 0.3, 0.25, 0.2)
KNOTS = 8


@form(
    "output",
    "y (1 + slope·Δ + bend·Δ²), Δ = angle - reference angle",
    *_PARABOLA,
    source="Marion, Wexler, Hull: 1 - 4.49e-4 Δθ² + 0.0344 Δθ, in degrees",
    scales=True,
)
def parabola(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    away = scene.away_rad
    return y * np.maximum(1.0 + p["slope_per_rad"] * away + p["bend_per_rad2"] * away * away, 0.0)


@form(
    "output",
    "y (1 + slope·Δ + bend·Δ² + twist·Δ³)",
    *_PARABOLA,
    Parameter("twist_per_rad3", "1/rad³", -12.0, 12.0, 0.0, (0.0,), about="third-order part"),
    scales=True,
)
def cubic(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    away = scene.away_rad
    bent = p["slope_per_rad"] * away + p["bend_per_rad2"] * away**2 + p["twist_per_rad3"] * away**3
    return y * np.maximum(1.0 + bent, 0.0)


@form(
    "output",
    "y exp(-sharpness ((Δ - best)² - best²))",
    Parameter("sharpness_per_rad2", "1/rad²", 0.0, 8.0, 0.0, (0.5,), about="sharpness of the length-tension curve"),
    Parameter("best_rad", "rad", -1.5, 1.5, 0.0, (0.5, -0.5), about="optimal angle, from the reference angle"),
    source="Gaussian active force-length curve, Thelen 2003",
    scales=True,
)
def bell(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    best = p["best_rad"]
    return y * np.exp(p["sharpness_per_rad2"] * (best * best - (scene.away_rad - best) ** 2))


@form(
    "output",
    "y (1 + c(angle)), c: linear between eight knots, for muscle length and moment arm together",
    *(
        Parameter(f"gain_{i}", "1", -0.8, 0.8, 0.0, (0.0,), about="additional share of torque at a knot")
        for i in range(KNOTS)
    ),
    source="Murray, Delp, Buchanan 1995: moment arms vary freely with the angle",
    scales=True,
)
def curve(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """Linear between knots over the fitted angles."""
    place = 0.5 * (scene.place + 1.0) * (KNOTS - 1)
    values = np.concatenate([p[f"gain_{i}"] for i in range(KNOTS)], axis=1)
    first = np.minimum(place.astype(np.int64), KNOTS - 2)
    part = place - first
    return y * (1.0 + values[:, first] * (1.0 - part) + values[:, first + 1] * part)


@form(
    "output",
    "y (1 + Σ bend_k (T_k(x) - T_k(reference))), x: place in the fitted range, -1 to 1",
    *(
        Parameter(f"bend_{i}", "1", -size, size, 0.0, (0.0,), about=f"polynomial of degree {i}")
        for i, size in enumerate(SIZES, start=1)
    ),
    source="shape free; Murray, Delp, Buchanan 1995; Thelen 2003 for what it has to follow",
    scales=True,
)
def smooth(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    bent = weighted(p, {f"bend_{i}": bend for i, bend in enumerate(scene.bends(len(SIZES)), start=1)})
    return y * np.maximum(1.0 + bent, 0.0)


EFFECT = Effect(
    id="torque_angle",
    name="Torque depends on angle",
    forms=(parabola, cubic, bell, curve, smooth),
    signature="The error follows the measured angle, but only under stimulation.",
    resembles=("torque_velocity", "fatigue"),
    separated_by="Isometric tests at three angles.",
    plain="The muscle is stronger at some elbow angles than at others. A controller that knows the angle can correct "
    "for it. A test at a single angle cannot show it.",
    source="Marion et al. 2010; Thelen 2003",
    needs=("angle_rad",),
    main={
        "slope_per_rad": "slope",
        "sharpness_per_rad2": "sharpness",
        "gain_0": "gain at the first knot",
        "bend_1": "slope over the angle",
    },
)
