"""Co-contraction: with both muscles at work the joint is stiffer, and less of each muscle's pull is measured."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.effects.base import Parameter
from stimrig.identify.muscles.interplay import Interplay, JointForm


def _against(levels: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Levels of the muscles that raise the torque, and of those that lower it."""
    up = np.clip(levels[signs > 0], 0.0, None).sum(axis=0)
    return up, np.clip(levels[signs < 0], 0.0, None).sum(axis=0)


def _yielding(levels: np.ndarray, signs: np.ndarray, p: dict[str, Any]) -> np.ndarray:
    up, down = _against(levels, signs)
    stiffer = p["stiffer_up"] * up + p["stiffer_down"] * down
    return -levels * stiffer / (1.0 + stiffer)


INTERPLAY = Interplay(
    id="co_contraction",
    name="Co-contraction",
    directed=False,
    forms=(
        JointForm(
            "yielding",
            "T = (T+ - T-) / (1 + k+ T+/F+ + k- T-/F-); T+, T- follow the pulses as each muscle alone does",
            (
                Parameter("stiffer_up", "1", 0.0, 0.6, 0.0, (0.1,), about="by the muscles that raise the torque"),
                Parameter("stiffer_down", "1", 0.0, 0.6, 0.0, (0.1,), about="by the muscles that lower it"),
            ),
            _yielding,
        ),
    ),
    signature="The torque with both muscles at work is smaller than the sum of what each gives alone.",
    resembles=("cross_talk",),
    separated_by="Both muscles held at several levels together, in all combinations.",
    plain="When both muscles pull at once the joint becomes stiffer, and less of either pull reaches the lever. It is "
    "no fault: it is why a joint with both muscles at work is steadier.",
    source="own form: muscles whose stiffness rises with their torque, on a fixture that gives way a little",
)
