"""Active torque depends on the joint's angle."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene


def _away(scene: Scene) -> np.ndarray:
    assert scene.angle_rad is not None
    return scene.angle_rad - scene.angle_rad[0]


def _parabola(y: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    away = _away(scene)
    return y * np.maximum(1.0 + p["slope_per_rad"] * away + p["bend_per_rad2"] * away * away, 0.0)


def _cubic(y: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    away = _away(scene)
    bent = p["slope_per_rad"] * away + p["bend_per_rad2"] * away**2 + p["twist_per_rad3"] * away**3
    return y * np.maximum(1.0 + bent, 0.0)


def _bell(y: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    sharp = p["sharpness_per_rad2"]
    best = p["best_rad"]
    return y * np.exp(sharp * (best * best - (_away(scene) - best) ** 2))


EFFECT = Effect(
    id="torque_angle",
    name="Torque depends on angle",
    forms=(
        Form(
            "parabola",
            "output",
            "y (1 + slope·Δ + bend·Δ²), Δ = angle - angle at the start",
            (
                Parameter("slope_per_rad", "1/rad", -4.0, 4.0, 0.0, (0.3, -0.3), about="at the angle of the start"),
                Parameter("bend_per_rad2", "1/rad²", -6.0, 6.0, 0.0, (0.0,), about="curvature"),
            ),
            _parabola,
            True,
            source="Marion, Wexler, Hull: 1 - 4.49e-4 Δθ² + 0.0344 Δθ, in degrees",
        ),
        Form(
            "cubic",
            "output",
            "y (1 + slope·Δ + bend·Δ² + twist·Δ³)",
            (
                Parameter("slope_per_rad", "1/rad", -4.0, 4.0, 0.0, (0.3, -0.3), about="at the angle of the start"),
                Parameter("bend_per_rad2", "1/rad²", -6.0, 6.0, 0.0, (0.0,), about="curvature"),
                Parameter("twist_per_rad3", "1/rad³", -12.0, 12.0, 0.0, (0.0,), about="one end against the other"),
            ),
            _cubic,
            True,
        ),
        Form(
            "bell",
            "output",
            "y exp(-sharpness ((Δ - best)² - best²))",
            (
                Parameter("sharpness_per_rad2", "1/rad²", 0.0, 8.0, 0.0, (0.5,), about="of the length-tension curve"),
                Parameter("best_rad", "rad", -1.5, 1.5, 0.0, (0.5, -0.5), about="optimal angle, from the start's"),
            ),
            _bell,
            True,
            source="Gaussian active force-length curve, Thelen 2003",
        ),
        Form(
            "drive",
            "gain",
            "w = f(u) (1 + slope·Δ + bend·Δ²): the muscle's force, before the dynamics",
            (
                Parameter("slope_per_rad", "1/rad", -4.0, 4.0, 0.0, (0.3, -0.3), about="at the angle of the start"),
                Parameter("bend_per_rad2", "1/rad²", -6.0, 6.0, 0.0, (0.0,), about="curvature"),
            ),
            _parabola,
            True,
        ),
    ),
    signature="The error follows the measured angle, and only under stimulation.",
    resembles=("torque_velocity", "fatigue"),
    separated_by="Isometric tests at three angles.",
    plain="The muscle is stronger at some elbow angles than at others. A controller that knows the angle can allow "
    "for it; a test at one angle can't show it.",
    source="Marion et al. 2010; Thelen 2003",
    needs=("angle_rad",),
    experiment=("ramp",),
)
