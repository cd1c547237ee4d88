"""A gain that varies without a law: if it beats every effect, the cause is not in the library."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene

KNOTS = 36


def _free_gain(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    place = np.clip(scene.time_s / max(scene.span_s, 1e-9), 0.0, 1.0) * (KNOTS - 1)
    first = np.minimum(place.astype(np.int64), KNOTS - 2)
    part = place - first
    values = np.concatenate([p[f"log_gain_{i}"] for i in range(KNOTS)], axis=1)
    return drive * np.exp(values[:, first] * (1.0 - part) + values[:, first + 1] * part)


FREE_GAIN = Effect(
    id="free_gain",
    name="Gain that varies without a law",
    forms=(
        Form(
            "free",
            "gain",
            "w = g(t) f(u), log g linear between knots",
            tuple(
                Parameter(f"log_gain_{i}", "1", -0.45, 0.45, 0.0, (0.0,), about="log gain at a knot")
                for i in range(KNOTS)
            ),
            _free_gain,
            batched=True,
        ),
    ),
    signature="",
    resembles=(),
    separated_by="",
    plain="",
)
