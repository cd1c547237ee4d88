"""Catch-like property: the first pulses of a train give more torque than the later ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene
from stimrig.identify.effects.kernels import adapt, since_onset, train, used_up

BURST_S, GAP_S = 0.06, 0.1
ENGAGED = 0.03
"""Share of full torque from which pulses are taken to recruit the muscle."""
_GAIN = Parameter("gain", "1", 0.0, 4.0, 0.0, (0.3, 0.8), about="extra torque at the onset")
_DECAY = Parameter("decay_s", "s", 0.12, 1.2, 0.3, (0.25, 0.5), "log", about="time constant of its decay")
_RECOVERY = Parameter(
    "recovery_s", "s", 0.02, 4.0, 0.3, (0.1, 1.0), "log", about="time constant of recovery in silence"
)


def _form(name: str, equation: str) -> Form:
    def used(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        by_level = name == "by_level"
        a = np.minimum(np.abs(drive) / scene.scale_nm, 1.0) if by_level else np.broadcast_to(scene.on, drive.shape)
        decay_s, recovery_s, begin = p["decay_s"][:, 0], p["recovery_s"][:, 0], scene.states.get("catch_like", 0.0)
        return adapt(a, decay_s, recovery_s, by_level, scene.step_s, scene.rest_s, begin)

    return Form(
        name,
        "gain",
        equation,
        (_GAIN, _DECAY, _RECOVERY),
        lambda drive, p, scene: drive * (1.0 + p["gain"] * (1.0 - used(drive, p, scene)[0])),
        batched=True,
        state=lambda drive, p, scene: used(drive, p, scene)[1],
    )


def _trains(least_gap_s: float) -> Any:
    """The boost at the onset of a train grows with the silence before it; shorter silences do not end a train."""

    def apply(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
        since, gap = train(scene.on, scene.step_s, least_gap_s)
        return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * np.exp(-since / p["decay_s"]))

    return apply


def _counts(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    x = used_up(scene.on, p["decay_s"][:, 0], p["recovery_s"][:, 0], scene.step_s)
    return drive * (1.0 + p["gain"] * np.exp(-x))


def _sharp(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """As `after_silence`, but the recovery has a threshold: after half the recovery time little has recovered."""
    since, gap = train(scene.on, scene.step_s)
    back = (gap / p["recovery_s"]) ** 2.5
    return drive * (1.0 + p["gain"] * back / (1.0 + back) * np.exp(-since / p["decay_s"]))


def _flat(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    since, gap = train(scene.on, scene.step_s)
    fade = np.exp(-np.minimum((since / p["length_s"]) ** 3, 200.0))
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * fade)


def _burst(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    since = since_onset(scene.on, GAP_S - 0.004, scene.step_s)
    return drive * (1.0 + p["gain"] * np.exp(-((since / BURST_S) ** 4)))


def _engaged(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    """A boost that rises and decays from the time at which pulses begin to recruit the muscle."""
    since, gap = np.empty_like(drive), np.empty_like(drive)
    for m in range(drive.shape[0]):
        working = (np.abs(drive[m]) > ENGAGED * scene.scale_nm).astype(float)
        since[m], gap[m] = train(working, scene.step_s)
    z = np.minimum(since / p["decay_s"], 50.0)
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * (z + 0.3) * np.exp(-z))


_QUICK = Parameter("decay_s", "s", 0.05, 1.2, 0.3, (0.12, 0.4), "log", about="time constant of its decay")

EFFECT = Effect(
    id="catch_like",
    name="Catch-like boost at the onset of a train",
    forms=(
        _form("depletes", "w = (1 + gain (1 - x)) f(u); x' = (1 - x)/decay under pulses, -x/recovery in silence"),
        _form("by_level", "w = (1 + gain (1 - x)) f(u); x' = a (1 - x)/decay - x/recovery; a = |f|/f_max"),
        *(
            Form(name, "gain", equation, (_GAIN, _QUICK, _RECOVERY), apply, batched=True)
            for name, equation, apply in (
                (
                    "after_silence",
                    "w = (1 + gain (1 - exp(-silence/recovery)) exp(-t/decay)) f(u), t since the onset of the train",
                    _trains(0.0),
                ),
                ("counts", "w = (1 + gain·exp(-x)) f(u); x' = 1/decay under pulses, -x/recovery in silence", _counts),
                ("sharp", "w = (1 + gain·r/(1 + r)·exp(-t/decay)) f(u), r = (silence/recovery)^2.5", _sharp),
                *(
                    (
                        f"trains_{gap * 1000:.0f}_ms",
                        f"as after_silence, but a silence of less than {gap:g} s does not end a train",
                        _trains(gap),
                    )
                    for gap in (0.12, 0.22)
                ),
            )
        ),
        Form(
            "engaged",
            "gain",
            "w = (1 + gain (1 - exp(-silence/recovery)) (z + 0.3) exp(-z)) f(u), z = t/decay, t since pulses recruit",
            (_GAIN, _QUICK, _RECOVERY),
            _engaged,
            batched=True,
            source="stiffness of the series elastic element at the onset: Parmiggiani, Stein 1981",
        ),
        Form(
            "flat",
            "gain",
            "w = (1 + gain (1 - exp(-silence/recovery)) exp(-(t/length)³)) f(u)",
            (
                _GAIN,
                Parameter("length_s", "s", 0.08, 0.9, 0.3, (0.15, 0.4), "log", about="duration of the boost"),
                _RECOVERY,
            ),
            _flat,
            batched=True,
        ),
        Form(
            f"burst_{BURST_S * 1000:.0f}_ms",
            "gain",
            f"w = (1 + gain·exp(-(t/{BURST_S:g} s)^4)) f(u), t since the first pulse after {GAP_S:g} s of silence",
            (_GAIN,),
            _burst,
            batched=True,
        ),
    ),
    signature="Torque above the model in the first tenths of a second after every rest.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "fatigue"),
    separated_by="Equal trains after rests of different length; one of them starts with a doublet.",
    plain="The first pulses after a rest give more torque than those that follow. Without it in the model, a "
    "controller overshoots at every start.",
    source="Bickel, Slade, Dudley 2004; Binder-Macleod, Kesar 2005",
)
