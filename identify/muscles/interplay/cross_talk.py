"""Cross-talk: the pulses of one channel also reach the muscle of another."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.effects.base import Form, Parameter, Scene
from stimrig.identify.muscles.interplay import DriveForm, Interplay, Other

PARAMETERS = (
    Parameter("share", "1", 0.0, 0.6, 0.0, (0.1, 0.25), about="of the other muscle that its largest pulse reaches"),
    Parameter("threshold", "1", 0.0, 0.9, 0.0, (0.4, 0.15), about="from which share of its largest width on"),
)


def _reached(p: dict[str, Any], other: Other) -> np.ndarray:
    threshold = p["threshold"]
    return p["share"] * other.mean(lambda width: np.clip((width - threshold) / (1.0 - threshold), 0.0, 1.0))


def _independent(other: Other) -> Form:
    def apply(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
        free = 1.0 - np.clip(drive / scene.scale_nm, 0.0, 1.0)
        return drive + scene.scale_nm * _reached(p, other) * free

    return Form("independent", "gain", INDEPENDENT, PARAMETERS, apply, batched=True)


def _nested(other: Other) -> Form:
    def apply(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
        return np.maximum(drive, scene.scale_nm * _reached(p, other))

    return Form("nested", "gain", NESTED, PARAMETERS, apply, batched=True)


INDEPENDENT = "w = f(u) + F c h(v) (1 - f(u)/F); h rises from 0 at the threshold to 1 at the largest width v"
NESTED = "w = max(f(u), F c h(v)); h rises from 0 at the threshold to 1 at the largest width v"

INTERPLAY = Interplay(
    id="cross_talk",
    name="Cross-talk",
    directed=True,
    forms=(DriveForm("independent", INDEPENDENT, _independent), DriveForm("nested", NESTED, _nested)),
    signature="With one muscle at work, pulses to the other one change the torque by less than they do alone, and "
    "with the first one's speed.",
    resembles=("co_contraction",),
    separated_by="Pulses to one channel alone, at several widths, and the same while the other one holds a level.",
    plain="The electrode of one muscle also reaches the other. A part of the pull is lost to the wrong muscle, and "
    "more stimulation helps less than expected. An electrode farther from the other muscle, or a smaller one, helps.",
    source="own form: of fibres that both electrodes reach none is counted twice",
)
