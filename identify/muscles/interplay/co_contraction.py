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


def _stiffness(levels: np.ndarray, signs: np.ndarray, p: dict[str, Any]) -> np.ndarray:
    up, down = _against(levels, signs)
    return -levels * p["loss"] * np.minimum(up, down)


def _compliance(levels: np.ndarray, signs: np.ndarray, p: dict[str, Any]) -> np.ndarray:
    up, down = _against(levels, signs)
    raising, lowering = p["loss_up"] * up, p["loss_down"] * down
    other = np.stack(np.broadcast_arrays(*[lowering if sign > 0 else raising for sign in signs]))
    return -levels * other / (1.0 + raising + lowering)


INTERPLAY = Interplay(
    id="co_contraction",
    name="Co-contraction",
    directed=False,
    forms=(
        JointForm(
            "stiffness",
            "T = (T+ - T-) (1 - k min(T+/F+, T-/F-))",
            (Parameter("loss", "1", -0.4, 0.6, 0.0, (0.1,), about="of the torque with both muscles at their largest"),),
            _stiffness,
        ),
        JointForm(
            "compliance",
            "T = (T+ (1 + k+ a+) - T- (1 + k- a-)) / (1 + k+ a+ + k- a-); a = T/F of each muscle alone",
            (
                Parameter("loss_up", "1", 0.0, 0.6, 0.0, (0.1,), about="by the muscles that raise the torque"),
                Parameter("loss_down", "1", 0.0, 0.6, 0.0, (0.1,), about="by the muscles that lower it"),
            ),
            _compliance,
        ),
    ),
    signature="The torque with both muscles at work is smaller than the sum of what each gives alone.",
    resembles=("cross_talk",),
    separated_by="Both muscles held at several levels together, in all combinations.",
    plain="When both muscles pull at once the joint becomes stiffer, and less of either pull reaches the lever. It is "
    "no fault: it is why a joint with both muscles at work is steadier.",
    source="own form: two muscles on a fixture that gives way a little; what each loses alone is in its curve",
)
