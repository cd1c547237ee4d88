"""Clipping: the load cell or its amplifier reaches the end of its range."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtr

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_CEILING = Parameter(
    "ceiling_nm", "N·m", -1.5, 1.5, np.inf, (0.9,), "linear", "level", "largest torque that the sensor shows"
)
_FLOOR = Parameter(
    "floor_nm", "N·m", -1.5, 1.5, -np.inf, (-0.5,), "linear", "level", "smallest torque that the sensor shows"
)


def _clipped(y: np.ndarray, ceiling: np.ndarray, scene: Scene) -> np.ndarray:
    """Mean of min(y + noise, ceiling): near the ceiling only positive noise is cut off."""
    sd = max(scene.noise_sd_nm, 1e-6)
    with np.errstate(invalid="ignore"):
        over = (y - ceiling) / sd
        bell = np.exp(-0.5 * np.minimum(over * over, 700.0)) / np.sqrt(2 * np.pi)
        cut = y - sd * (over * ndtr(over) + bell)
    return np.where(np.isinf(ceiling), y, cut)


@form("sensor", "min(y + noise, ceiling)", _CEILING)
def ceiling(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _clipped(y, p["ceiling_nm"], scene)


@form("sensor", "max(y + noise, floor)", _FLOOR)
def floor(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return -_clipped(-y, -p["floor_nm"], scene)


@form("sensor", "min(max(y + noise, floor), ceiling)", _CEILING, _FLOOR)
def both(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return -_clipped(-_clipped(y, p["ceiling_nm"], scene), -p["floor_nm"], scene)


def _detect(raw: Any) -> tuple[str, dict[str, float]] | None:
    levels = {"ceiling": raw.ceiling_nm, "floor": raw.floor_nm}
    clipped = {name: value for name, value in levels.items() if value is not None}
    if not clipped:
        return None
    parameters = {f"{name}_nm": value for name, value in clipped.items()}
    return "both" if len(clipped) == 2 else next(iter(clipped)), parameters


EFFECT = Effect(
    id="sensor_clipping",
    name="Clipping of the sensor",
    forms=(ceiling, floor, both),
    signature="Flat peaks: many samples have exactly the same largest (or smallest) value.",
    resembles=("output_saturation",),
    separated_by="The same test with a lower amplifier gain: clipping then disappears, saturation of the muscle "
    "remains.",
    plain="The measurement reaches the end of its range: the muscle gives more torque than the load cell shows. "
    "Reduce the amplifier's gain, or the charge.",
    source="Range of the analogue-to-digital converter",
    detect=_detect,
    muscle=False,
    main={"ceiling_nm": "ceiling", "floor_nm": "floor"},
)
