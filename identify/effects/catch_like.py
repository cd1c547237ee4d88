"""Catch-like property: the first pulses of a train give more torque than the later ones."""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form, slow_gain

ENDS_S = 0.12
ENGAGED = 0.03
"""Share of full torque from which pulses are taken to recruit the muscle."""
_GAIN = Parameter("gain", "1", 0.0, 4.0, 0.0, (0.3, 0.8), about="extra torque at the onset")
_DECAY = Parameter("decay_s", "s", 0.12, 1.2, 0.3, (0.25, 0.5), "log", about="time constant of its decay")
_QUICK = Parameter("decay_s", "s", 0.05, 1.2, 0.3, (0.12, 0.4), "log", about="time constant of its decay")
_RECOVERY = Parameter(
    "recovery_s", "s", 0.02, 4.0, 0.3, (0.1, 1.0), "log", about="time constant of recovery in silence"
)
_TRAIN = (_GAIN, _QUICK, _RECOVERY)


@njit(cache=True, nogil=True)
def _train(on, step_s, least_gap_s=0.0):  # pragma: no cover
    """Time under pulses since the onset of the present train, and the silence before that train, s, shape (K,).

    `on`, shape (K,), is above 0 under pulses. A silence longer than `least_gap_s` ends a train.
    """
    since = np.full(on.size, 1e9)
    before = np.zeros(on.size)
    gap, length, silence = 1e3, 0.0, 1e3
    for k in range(on.size):
        if on[k] > 0:
            if gap > least_gap_s:
                silence, length = gap, 0.0
            gap = 0.0
            since[k] = length + 0.5 * step_s
            before[k] = silence
            length += step_s
        else:
            gap += step_s
    return since, before


@form(
    "gain",
    "w = (1 + gain (1 - exp(-silence/recovery)) (z + 0.3) exp(-z)) f(u), z = t/decay, t since pulses recruit",
    *_TRAIN,
    source="stiffness of the series elastic element at the onset: Parmiggiani, Stein 1981",
)
def engaged(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """A boost that rises and decays from the time at which pulses begin to recruit the muscle."""
    since, gap = np.empty_like(drive), np.empty_like(drive)
    for m in range(drive.shape[0]):
        working = (np.abs(drive[m]) > ENGAGED * scene.scale_nm).astype(float)
        since[m], gap[m] = _train(working, scene.step_s)
    z = np.minimum(since / p["decay_s"], 50.0)
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * (z + 0.3) * np.exp(-z))


@form(
    "gain",
    "w = (1 + gain (1 - exp(-silence/recovery)) exp(-t/decay)) f(u), t since the onset of the train; a silence of less "
    f"than {ENDS_S:g} s does not end one",
    *_TRAIN,
    name="trains_120_ms",
)
def trains(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """The boost at the onset of a train grows with the silence before it."""
    since, gap = _train(scene.on, scene.step_s, ENDS_S)
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * np.exp(-since / p["decay_s"]))


EFFECT = Effect(
    id="catch_like",
    name="Catch-like boost at the onset of a train",
    forms=(
        slow_gain(
            "catch_like",
            (_GAIN, _DECAY, _RECOVERY),
            lambda p, x: 1.0 + p["gain"] * (1.0 - x),
            "by_level",
            "w = (1 + gain (1 - x)) f(u); x' = a (1 - x)/decay - x/recovery; a = |f|/f_max",
            constant=True,
        ),
        trains,
        engaged,
    ),
    signature="Torque above the model in the first tenths of a second after every rest.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "fatigue"),
    separated_by="Equal trains after rests of different length; one of them starts with a doublet.",
    plain="The first pulses after a rest give more torque than those that follow. Without it in the model, a "
    "controller overshoots at every start.",
    source="Bickel, Slade, Dudley 2004; Binder-Macleod, Kesar 2005",
    main={"gain": "gain"},
)
