"""Development and decay of torque with time constants of their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene
from identify.effects.kernels import activate

_RATIO = Parameter("ratio", "1", 0.12, 8.0, 1.0, (1.6, 0.6), "log", about="time constant of decay over development")


def _kinetics(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return activate(np.ascontiguousarray(drive), p["rise_s"][:, 0], p["fall_s"][:, 0], scene.step_s)


EFFECT = Effect(
    id="asymmetric_relaxation",
    name="Contraction and relaxation differ in speed",
    forms=(
        Form(
            "by_drive",
            "speed",
            "T·ratio while the drive is below the torque, T above",
            (_RATIO,),
            law={"ratio": 0},
            log_law=True,
        ),
        Form(
            "by_rate",
            "speed",
            "T·ratio while the torque falls, T while it rises",
            (_RATIO,),
            law={"ratio": 1},
            log_law=True,
        ),
        Form(
            "damping",
            "speed",
            "as by_drive, on the damping alone: the slower of two lags",
            (_RATIO,),
            law={"ratio": 8},
            log_law=True,
        ),
        Form(
            "kinetics",
            "gain",
            "a' = (w - a)/τ, τ = rise where w > a, else fall; the second order follows a",
            (
                Parameter("rise_s", "s", 0.0, 0.35, 0.0, (0.02, 0.1), about="activation"),
                Parameter("fall_s", "s", 0.0, 0.35, 0.0, (0.08, 0.03), about="deactivation"),
            ),
            _kinetics,
            True,
            source="Winters, Stark 1985; Thelen 2003: activation 10 ms, deactivation 40 ms",
        ),
    ),
    signature="Torque above the model on the way up and below it on the way down, or the reverse, at every switch.",
    resembles=("output_saturation", "activation_dependent_speed", "catch_like", "mixed_fibres"),
    separated_by="Steps on and off at several levels.",
    plain="The muscle relaxes at another speed than it contracts. After a stroke both are changed, each by itself. A "
    "controller with one speed reacts too late in one direction.",
    source="McCrea, Eng, Hodgson 2003 (development and decay impaired independently); Thelen 2003",
    experiment=("steps", "prbs"),
)
