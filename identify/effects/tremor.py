"""Tremor: a narrow band of torque between 3 and 14 Hz."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values

KNOTS = (1, 8, 20, 45, 90, 180)
"""Number of times between which the amplitudes are linear, for each form."""
_FREQUENCY = Parameter("frequency_hz", "Hz", 2.6, 14.0, 5.0, (5.0,), "log", about="tremor frequency")


def _wave(p: Values, scene: Scene, knots: int) -> np.ndarray:
    turn = 2 * np.pi * p["frequency_hz"] * scene.time_s
    cos, sin = np.cos(turn), np.sin(turn)
    place = scene.share_of_span * (knots - 1)
    total = np.zeros(turn.shape)
    for i in range(knots):
        hat = np.maximum(1.0 - np.abs(place - i), 0.0)
        near = hat > 0
        total[..., near] += hat[near] * (p[f"cos_{i}_nm"] * cos[..., near] + p[f"sin_{i}_nm"] * sin[..., near])
    return total


def _form(knots: int) -> Form:
    amplitude = (-0.4, 0.4, 0.0, (0.0,), "linear", "torque")
    parts = (Parameter(f"{part}_{i}_nm", "N·m", *amplitude) for i in range(knots) for part in ("cos", "sin"))
    return Form(
        "steady" if knots == 1 else f"waxing_{knots}",
        "additive",
        "y + A(t) cos(2πft) + B(t) sin(2πft)" + ("" if knots == 1 else f", A and B linear between {knots} times"),
        (_FREQUENCY, *parts),
        lambda _, p, scene: _wave(p, scene, knots),
        batched=True,
    )


EFFECT = Effect(
    id="tremor",
    name="Tremor",
    forms=tuple(_form(knots) for knots in KNOTS),
    signature="A line or a narrow peak in the residual's spectrum between 3 and 14 Hz, also at rest.",
    resembles=(),
    separated_by="The spectrum of a rest.",
    plain="The limb trembles. This adds to the torque, but the pulses do not cause it, so it cannot be predicted.",
    source="Narrow band near 5 Hz (pathological) or from 8 to 12 Hz (physiological)",
    predictable=False,
    sporadic=True,
    band=True,
    muscle=False,
    main={"frequency_hz": "frequency"},
)
