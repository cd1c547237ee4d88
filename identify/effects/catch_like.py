"""Catch-like property: the first pulses of a train give more torque than the later ones."""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values, form, slow_gain

BURST_S, GAP_S = 0.06, 0.1
ENGAGED = 0.03
"""Share of full torque from which pulses are taken to recruit the muscle."""
_GAIN = Parameter("gain", "1", 0.0, 4.0, 0.0, (0.3, 0.8), about="extra torque at the onset")
_DECAY = Parameter("decay_s", "s", 0.12, 1.2, 0.3, (0.25, 0.5), "log", about="time constant of its decay")
_QUICK = Parameter("decay_s", "s", 0.05, 1.2, 0.3, (0.12, 0.4), "log", about="time constant of its decay")
_LENGTH = Parameter("length_s", "s", 0.08, 0.9, 0.3, (0.15, 0.4), "log", about="duration of the boost")
_RECOVERY = Parameter(
    "recovery_s", "s", 0.02, 4.0, 0.3, (0.1, 1.0), "log", about="time constant of recovery in silence"
)
_depleting = partial(slow_gain, "catch_like", (_GAIN, _DECAY, _RECOVERY), lambda p, x: 1.0 + p["gain"] * (1.0 - x))


def _trains(name: str, equation: str, least_gap_s: float) -> Form:
    """The boost at the onset of a train grows with the silence before it; shorter silences do not end a train."""

    def apply(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
        since, gap = _train(scene.on, scene.step_s, least_gap_s)
        return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * np.exp(-since / p["decay_s"]))

    return Form(name, "gain", equation, (_GAIN, _QUICK, _RECOVERY), apply, batched=True)


@njit(cache=True, nogil=True)
def _train(
    on: np.ndarray, step_s: float, least_gap_s: float, within: bool = False
) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """Time under pulses since the onset of the present train, and the silence before that train, s.

    A silence longer than `least_gap_s` ends a train; `within` counts the time of shorter ones, too.
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
            if within:
                length += step_s
    return since, before


@njit(cache=True, nogil=True)
def _used_up(
    on: np.ndarray, decay_s: np.ndarray, recovery_s: np.ndarray, step_s: float
) -> np.ndarray:  # pragma: no cover
    """x' = 1/decay under pulses, -x/recovery in silence. Shapes (K,), (M,), (M,); to (M, K)."""
    rows = decay_s.size
    out = np.empty((rows, on.size))
    for m in range(rows):
        x, gain, forget = 0.0, step_s / decay_s[m], np.exp(-step_s / recovery_s[m])
        for k in range(on.size):
            if on[k] > 0:
                out[m, k] = x + 0.5 * gain
                x += gain
            else:
                out[m, k] = x
                x *= forget
    return out


@form(
    "gain", "w = (1 + gain·exp(-x)) f(u); x' = 1/decay under pulses, -x/recovery in silence", _GAIN, _QUICK, _RECOVERY
)
def counts(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    x = _used_up(scene.on, p["decay_s"][:, 0], p["recovery_s"][:, 0], scene.step_s)
    return drive * (1.0 + p["gain"] * np.exp(-x))


@form("gain", "w = (1 + gain·r/(1 + r)·exp(-t/decay)) f(u), r = (silence/recovery)^2.5", _GAIN, _QUICK, _RECOVERY)
def sharp(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """As `after_silence`, but the recovery has a threshold: after half the recovery time little has recovered."""
    since, gap = _train(scene.on, scene.step_s, 0.0)
    back = (gap / p["recovery_s"]) ** 2.5
    return drive * (1.0 + p["gain"] * back / (1.0 + back) * np.exp(-since / p["decay_s"]))


@form(
    "gain",
    "w = (1 + gain (1 - exp(-silence/recovery)) (z + 0.3) exp(-z)) f(u), z = t/decay, t since pulses recruit",
    _GAIN,
    _QUICK,
    _RECOVERY,
    source="stiffness of the series elastic element at the onset: Parmiggiani, Stein 1981",
)
def engaged(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """A boost that rises and decays from the time at which pulses begin to recruit the muscle."""
    since, gap = np.empty_like(drive), np.empty_like(drive)
    for m in range(drive.shape[0]):
        working = (np.abs(drive[m]) > ENGAGED * scene.scale_nm).astype(float)
        since[m], gap[m] = _train(working, scene.step_s, 0.0)
    z = np.minimum(since / p["decay_s"], 50.0)
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * (z + 0.3) * np.exp(-z))


@form("gain", "w = (1 + gain (1 - exp(-silence/recovery)) exp(-(t/length)³)) f(u)", _GAIN, _LENGTH, _RECOVERY)
def flat(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    since, gap = _train(scene.on, scene.step_s, 0.0)
    fade = np.exp(-np.minimum((since / p["length_s"]) ** 3, 200.0))
    return drive * (1.0 + p["gain"] * -np.expm1(-gap / p["recovery_s"]) * fade)


@form(
    "gain",
    f"w = (1 + gain·exp(-(t/{BURST_S:g} s)^4)) f(u), t since the first pulse after {GAP_S:g} s of silence",
    _GAIN,
    name=f"burst_{BURST_S * 1000:.0f}_ms",
)
def burst(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    since, _ = _train(scene.on, scene.step_s, np.nextafter(GAP_S - 0.004, 0.0), True)  # just as long ends it, too
    return drive * (1.0 + p["gain"] * np.exp(-((since / BURST_S) ** 4)))


EFFECT = Effect(
    id="catch_like",
    name="Catch-like boost at the onset of a train",
    forms=(
        _depleting(
            "depletes",
            "w = (1 + gain (1 - x)) f(u); x' = (1 - x)/decay under pulses, -x/recovery in silence",
            by_pulses=True,
        ),
        _depleting(
            "by_level", "w = (1 + gain (1 - x)) f(u); x' = a (1 - x)/decay - x/recovery; a = |f|/f_max", constant=True
        ),
        _trains(
            "after_silence",
            "w = (1 + gain (1 - exp(-silence/recovery)) exp(-t/decay)) f(u), t since the onset of the train",
            0.0,
        ),
        counts,
        sharp,
        *(
            _trains(
                f"trains_{gap * 1000:.0f}_ms",
                f"as after_silence, but a silence of less than {gap:g} s does not end a train",
                gap,
            )
            for gap in (0.12, 0.22)
        ),
        engaged,
        flat,
        burst,
    ),
    signature="Torque above the model in the first tenths of a second after every rest.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "fatigue"),
    separated_by="Equal trains after rests of different length; one of them starts with a doublet.",
    plain="The first pulses after a rest give more torque than those that follow. Without it in the model, a "
    "controller overshoots at every start.",
    source="Bickel, Slade, Dudley 2004; Binder-Macleod, Kesar 2005",
    main={"gain": "gain"},
)
