"""Hysteresis of recruitment: rising and falling pulse widths recruit differently."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene
from identify.effects.kernels import dahl, play


def _play(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return play(np.ascontiguousarray(width), p["half_width_us"][:, 0])


def _memory(width: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    z = dahl(np.ascontiguousarray(width), p["reach_us"][:, 0])
    return np.where(width > 0, width - p["half_width_us"] * z, width)


def _gain(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    width = np.broadcast_to(scene.pulse_width_us, drive.shape)
    return drive * (1.0 - p["share"] * dahl(np.ascontiguousarray(width), p["reach_us"][:, 0]))


_HALF = Parameter("half_width_us", "µs", 0.0, 45.0, 0.0, (8.0, 20.0), about="half the distance of the two curves")
_REACH = Parameter("reach_us", "µs", 1.0, 80.0, 10.0, (4.0, 25.0), "log", about="change of width that turns it over")

EFFECT = Effect(
    id="recruitment_hysteresis",
    name="Hysteresis of recruitment",
    forms=(
        Form(
            "play",
            "pulse_width",
            "w = f(p); p = max(u - r, min(u + r, p_before)), r = half_width",
            (_HALF,),
            _play,
            True,
        ),
        Form(
            "memory",
            "pulse_width",
            "w = f(u - half_width·z); dz = (du - z|du|)/reach",
            (_HALF, _REACH),
            _memory,
            True,
            source="Dahl's friction as direction memory; Bouc, Wen",
        ),
        Form(
            "gain",
            "gain",
            "w = (1 - share·z) f(u); dz = (du - z|du|)/reach",
            (Parameter("share", "1", -0.6, 0.6, 0.0, (0.08, -0.08), about="half the difference"), _REACH),
            _gain,
            True,
        ),
    ),
    signature="Torque below the model while the pulse width rises, above it while it falls, at equal widths.",
    resembles=("voluntary_effort", "threshold_drift", "fatigue", "asymmetric_relaxation"),
    separated_by="The ramp twice, at two speeds: hysteresis is the same at both, a slow muscle or fatigue is not.",
    plain="The muscle answers differently to the same pulse on the way up and on the way down. The controller needs to "
    "know where it comes from, or it will be off by the distance of two curves.",
    source="Two curves, one a direction, come out of a ramp's deconvolution: Durfee, MacLean 1989",
    experiment=("ramp",),
)
