"""A free effect: torque that builds up with work and goes away at rest."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Shape
from stimrig.identify.effects.use import BY, DRIVER, EMPTY, FILL, STATE, TIME_S, course, percent, seconds


def _shape(_form: Form, values: Mapping[str, float]) -> Shape:
    added = values["zero"] * course(values)
    largest = float(added[np.argmax(np.abs(added))])
    words = (
        f"20 s of full work add {percent(largest)} of the largest torque, which goes away at rest with a time constant "
        f"of {seconds(values['empty_s'])}."
    )
    axes = DRIVER, TIME_S, "torque added (share of the largest)"
    return Shape("zero", "sum of the past", words, *axes, {"torque added": added})


EFFECT = Effect(
    id="free_zero",
    name="Torque that outlasts the stimulation",
    forms=tuple(
        Form(
            name,
            "lags",
            "y + zero·y_max·s; s' = a (1 - s)/fill - (1 - a) s/empty; a: "
            + {"by_torque": "torque", "by_pulses": "1 under pulses"}[name],
            (FILL, EMPTY, Parameter("zero", "1", -0.5, 0.5, 0.0, (0.02,), about="torque added after long work")),
            law=STATE | {"zero": FreeLaw.ZERO},
            held=BY[name],
        )
        for name in ("by_torque", "by_pulses")
    ),
    signature="The torque at rest, or the level reached, depends on the work before.",
    resembles=("baseline_drift", "mixed_fibres", "free_strength", "free_ways"),
    separated_by="A long train, then a long rest.",
    plain="Work leaves a torque behind, which goes away slowly: the picture shows how much and how long. No effect of "
    "the library describes it.",
    source="cf. plateau potentials, creep of a fixture",
    main={"zero": "torque left by work"},
    shape=_shape,
)
