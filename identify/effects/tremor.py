"""Tremor: a narrow band of torque between 3 and 14 Hz."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene

LOWEST_HZ, HIGHEST_HZ = 2.6, 14.0
LEAST_PEAK = 14.0
"""Peak of the residual's spectrum over its neighbours that makes a tremor worth a fit."""


def _wave(knots: int) -> Callable[..., np.ndarray]:
    def apply(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
        turn = 2 * np.pi * p["frequency_hz"] * scene.time_s
        cos, sin = np.cos(turn), np.sin(turn)
        if knots == 1:
            return p["cos_0_nm"] * cos + p["sin_0_nm"] * sin
        place = np.clip((scene.time_s - scene.time_s[0]) / max(scene.span_s, 1e-9), 0.0, 1.0) * (knots - 1)
        total = np.zeros(turn.shape)
        for i in range(knots):
            hat = np.maximum(1.0 - np.abs(place - i), 0.0)
            near = hat > 0
            total[..., near] += hat[near] * (p[f"cos_{i}_nm"] * cos[..., near] + p[f"sin_{i}_nm"] * sin[..., near])
        return total

    return apply


def spectrum_peak(residual_nm: np.ndarray, scene: Scene) -> tuple[float, float]:
    """Frequency, Hz, and height over its neighbours of the tallest line between 2.6 and 14 Hz."""
    value = np.where(np.isfinite(residual_nm), residual_nm, 0.0)
    value = value - value.mean()
    size = value.size
    power = np.abs(np.fft.rfft(value * np.hanning(size))) ** 2
    # Two or three neighbouring lines together: a tremor that waxes and wanes isn't a single line.
    power = np.convolve(power, np.ones(5), "same")
    frequency = np.fft.rfftfreq(size, scene.step_s)
    width = max(int(1.0 * size * scene.step_s), 8)
    inside = np.flatnonzero((frequency > LOWEST_HZ) & (frequency < min(HIGHEST_HZ, 0.45 / scene.step_s)))
    if inside.size == 0:
        return 0.0, 0.0
    best = (0.0, 0.0)
    for i in inside:
        around = np.r_[power[max(i - 3 * width, 1) : i - width], power[i + width : i + 3 * width]]
        if around.size:
            ratio = power[i] / max(float(np.median(around)), 1e-30)
            best = max(best, (float(ratio), float(frequency[i])))
    return best[1], best[0]


def _propose(knots: int) -> Callable[..., list[dict[str, float]]]:
    def propose(residual_nm: np.ndarray, scene: Scene, previous: dict[str, float]) -> list[dict[str, float]]:
        frequency_hz, ratio = spectrum_peak(residual_nm, scene)
        if previous:
            frequency_hz = previous["frequency_hz"]
        elif ratio < LEAST_PEAK:
            return []
        blank = {f"{part}_{i}_nm": 0.0 for i in range(knots) for part in ("cos", "sin")}
        return [{"frequency_hz": frequency_hz} | blank]

    return propose


def _form(knots: int) -> Form:
    amplitude = (-0.4, 0.4, 0.0, (0.0,), "linear", "torque")
    parts = [Parameter(f"{part}_{i}_nm", "N·m", *amplitude) for i in range(knots) for part in ("cos", "sin")]
    frequency = Parameter("frequency_hz", "Hz", LOWEST_HZ, HIGHEST_HZ, 5.0, (5.0,), "log", about="tremor frequency")
    return Form(
        "steady" if knots == 1 else f"waxing_{knots}",
        "additive",
        "y + A(t) cos(2πft) + B(t) sin(2πft)" + ("" if knots == 1 else f", A and B linear between {knots} times"),
        (frequency, *parts),
        _wave(knots),
        batched=True,
        propose=_propose(knots),
        grows=knots > 1,
    )


EFFECT = Effect(
    id="tremor",
    name="Tremor",
    forms=tuple(_form(knots) for knots in (1, 8, 20, 44)),
    signature="A line or narrow hump in the residual's spectrum between 3 and 14 Hz, in rests as well.",
    resembles=(),
    separated_by="The spectrum at rest.",
    plain="The limb trembles. It adds to the torque but isn't caused by the pulses, and can't be predicted from them.",
    source="Narrow band near 5 Hz (pathological), 8 to 12 Hz (physiological)",
    foreseeable=False,
    experiment=("rest",),
)
