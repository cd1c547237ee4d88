"""Catch-like property: the first pulses of a train give more than the later ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene
from identify.effects.kernels import adapt, since_onset

_GAIN = Parameter("gain", "1", 0.0, 2.5, 0.0, (0.3, 0.8), about="extra torque at the onset")
_DECAY = Parameter("decay_s", "s", 0.12, 1.2, 0.3, (0.25, 0.5), "log", about="time constant with which it fades")
_RECOVERY = Parameter("recovery_s", "s", 0.02, 4.0, 0.3, (0.1, 1.0), "log", about="silence after which it is back")


def _depletes(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    on = np.broadcast_to(scene.on, drive.shape)
    x = adapt(on, p["decay_s"][:, 0], p["recovery_s"][:, 0], False, scene.step_s)
    return drive * (1.0 + p["gain"] * (1.0 - x))


def _since(least_gap_s: float) -> Any:
    def apply(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
        since = since_onset(scene.on, least_gap_s, scene.step_s)
        return drive * (1.0 + p["gain"] * np.exp(-since / p["decay_s"]))

    return apply


EFFECT = Effect(
    id="catch_like",
    name="Catch-like boost at the onset of a train",
    forms=(
        Form(
            "depletes",
            "gain",
            "w = (1 + gain (1 - x)) f(u); x' = (1 - x)/decay under pulses, -x/recovery in silence",
            (_GAIN, _DECAY, _RECOVERY),
            _depletes,
            batched=True,
        ),
        *(
            Form(
                f"after_{gap * 1000:.0f}_ms",
                "gain",
                f"w = (1 + gain·exp(-t/decay)) f(u), t since the first pulse after a silence of {gap:g} s or more",
                (_GAIN, _DECAY),
                _since(gap - 0.004),
                batched=True,
            )
            for gap in (0.025, 0.1, 0.25)
        ),
    ),
    signature="Torque above the model in the first tenths of a second after every silence.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "fatigue"),
    separated_by="Plain trains after silences of different length, one of them opened by a doublet.",
    plain="The first pulses after a silence pull harder than those that follow. Trains that begin with a close pair of "
    "pulses use this; a controller that doesn't know it overshoots at every start.",
    source="Bickel, Slade, Dudley 2004; Binder-Macleod, Kesar 2005",
    experiment=("steps", "rest"),
)
