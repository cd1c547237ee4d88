"""Mains hum: a line at 50 or 60 Hz and its harmonics, detected in the samples."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

HARMONICS = 4


def line(p: Values, time_s: np.ndarray) -> np.ndarray:
    """The mains line and its harmonics at given times, N·m."""
    total = np.zeros(np.broadcast_shapes(np.shape(p["frequency_hz"]), time_s.shape))
    for h in range(1, HARMONICS + 1):
        turn = 2 * np.pi * h * p["frequency_hz"] * time_s
        total = total + p[f"cos_{h}_nm"] * np.cos(turn) + p[f"sin_{h}_nm"] * np.sin(turn)
    return total


@form(
    "sensor",
    "y + Σ cos_h cos(2πhft) + sin_h sin(2πhft)",
    Parameter("frequency_hz", "Hz", 49.0, 61.0, 50.0, (50.0, 60.0), about="mains frequency"),
    *(
        Parameter(f"{part}_{h}_nm", "N·m", -0.5, 0.5, 0.0, (0.0,), "linear", "torque", f"harmonic {h}")
        for h in range(1, HARMONICS + 1)
        for part in ("cos", "sin")
    ),
    name="line",
    fixed=True,
)
def hum(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return y + line(p, scene.time_s)


EFFECT = Effect(
    id="mains_hum",
    name="Mains hum",
    forms=(hum,),
    signature="Lines at 50 or 60 Hz and multiples; in means over pulse intervals they appear at low frequencies.",
    resembles=(),
    separated_by="The spectrum of a rest, at a high sampling rate.",
    plain="The mains supply disturbs the load cell; the muscle is not the cause. Check shielding and earth.",
    source="Electrical interference",
    predictable=False,
    detect=lambda raw: None if raw.hum is None else ("line", raw.hum),
    muscle=False,
    main={"frequency_hz": "frequency"},
)
