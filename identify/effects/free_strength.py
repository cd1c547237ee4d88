"""A free effect: strength and speed that change with what the muscle has done."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Shape
from stimrig.identify.effects.use import BY, DRIVER, EMPTY, FILL, STATE, TIME_S, course, percent, seconds

_PARAMETERS = (
    FILL,
    EMPTY,
    Parameter("gain", "1", -0.95, 1.5, 0.0, (-0.1,), about="change of strength after long work, as a share"),
    Parameter("rate", "1", -1.5, 1.5, 0.0, (-0.1,), about="log of the change of speed after long work"),
)


def _shape(_form: Form, values: Mapping[str, float]) -> Shape:
    state = course(values)
    strength, speed = 1.0 + values["gain"] * state, np.exp(values["rate"] * state)
    top = int(np.argmax(state))
    slowed = abs(values["rate"]) > abs(np.log(max(1.0 + values["gain"], 0.05)))
    words = (
        f"After 20 s of full work the strength has changed by {percent(strength[top] - 1.0)} and the speed by "
        f"{percent(speed[top] - 1.0)}; at rest this goes away with a time constant of {seconds(values['empty_s'])}."
    )
    lines = {"strength": strength, "speed": speed}
    enters = "rate of fall" if slowed else "drive"
    return Shape(enters, "sum of the past", words, DRIVER, TIME_S, "strength and speed, rested: 1", lines)


EFFECT = Effect(
    id="free_strength",
    name="Strength and speed that change with use",
    forms=tuple(
        Form(
            name,
            "lags",
            "w = (1 + gain·s) f(u), both rates · exp(rate·s); s' = a (1 - s)/fill - (1 - a) s/empty; a: "
            + {"by_torque": "torque", "by_pulses": "1 under pulses", "by_drive": "f(u)"}[name],
            _PARAMETERS,
            law=STATE | {"gain": FreeLaw.GAIN, "rate": FreeLaw.RATE},
            held=fixed_laws,
        )
        for name, fixed_laws in BY.items()
    ),
    signature="Early and late answers to the same pulses differ in size, and in speed.",
    resembles=("free_ways", "free_zero"),
    separated_by="The same steps before and after long work, and once more after a rest.",
    plain="The muscle answers otherwise after it has worked: the picture shows by how much, and how soon it recovers. "
    "No effect of the library describes it.",
    source="a slow state with gain and rate, free in sign; cf. Ding et al. 2003",
    main={"gain": "gain"},
    shape=_shape,
)
