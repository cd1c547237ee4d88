"""A free effect: the torque itself changes what is recruited, or what arrives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Shape, Values, form
from stimrig.identify.effects.use import percent

LEVEL = np.linspace(0.0, 1.0, 41)


def _bent(level: np.ndarray, p: Values) -> np.ndarray:
    """Torque added to a level; 0 at zero and at full torque."""
    return level * (1.0 - level) * (p["bend"] + p["skew"] * (1.0 - 2.0 * level))


@form(
    "output",
    "y + y_max·l (1 - l)(bend + skew (1 - 2 l)), l = y/y_max",
    Parameter("bend", "1", -1.5, 1.5, 0.0, (0.1,), about="twice the change at half of the torque, as its share"),
    Parameter("skew", "1", -1.5, 1.5, 0.0, (0.0,), about="the same, more at low levels than at high ones"),
)
def after(torque: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return torque + scene.scale_nm * _bent(np.clip(torque / scene.scale_nm, 0.0, 1.3), p)


_BEFORE = Form(
    "before",
    "lags",
    "w = (1 + feedback·y/y_max) f(u)",
    (Parameter("feedback", "1", -1.0, 1.0, 0.0, (0.05,), about="change of the drive at full torque, as a share"),),
    law={"feedback": FreeLaw.FEEDBACK},
)


def _shape(effect_form: Form, values: Mapping[str, float]) -> Shape:
    driver = "torque (share of the largest)"
    if effect_form.name == "before":
        share = values["feedback"]
        words = f"At full torque the drive by the same pulse has changed by {percent(share)}."
        return Shape("drive", "torque", words, driver, LEVEL, "drive, at rest: 1", {"drive": 1.0 + share * LEVEL})
    torque = LEVEL + _bent(LEVEL, dict(values))
    words = f"Half of the torque arrives changed by {percent(torque[20] / 0.5 - 1.0)}, behind the dynamics."
    return Shape("output", "torque", words, driver, LEVEL, "torque that arrives (share)", {"torque": torque})


EFFECT = Effect(
    id="free_level",
    name="Torque that acts on itself",
    forms=(after, _BEFORE),
    signature="Rise and fall bend differently at low and at high torque.",
    resembles=("output_saturation", "free_speed"),
    separated_by="Steps between several levels.",
    plain="How much torque there is changes what the same pulse adds: the picture shows how. No effect of the library "
    "describes it.",
    source="cf. electrodes that move with the muscle, springs that stiffen",
    main={"bend": "bend", "feedback": "change of the drive"},
    shape=_shape,
)
