"""A free effect: two lags whose rates depend on level and direction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import LOW, FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Shape

_LAW = {
    "first_direction": FreeLaw.FIRST_DIRECTION,
    "first_rising": FreeLaw.FIRST_RISING,
    "first_falling": FreeLaw.FIRST_FALLING,
    "second_direction": FreeLaw.SECOND_DIRECTION,
    "second_rising": FreeLaw.SECOND_RISING,
    "second_falling": FreeLaw.SECOND_FALLING,
    "coupling": FreeLaw.COUPLING,
}
_ABOUT = {
    "direction": "log of the rate while rising over that while falling",
    "rising": "power of the level in the rate while rising",
    "falling": "power of the level in the rate while falling",
    "coupling": "how much the second lag's distance drives the first",
}
LEVEL = np.linspace(0.0, 1.0, 41)


def _shape(_form: Form, values: Mapping[str, float]) -> Shape:
    lines, power = {}, np.log((LEVEL + LOW) / (1.0 + LOW))
    for way, sign in (("rising", 0.5), ("falling", -0.5)):
        lines[way] = np.exp(
            np.mean(
                [sign * values[f"{lag}_direction"] + values[f"{lag}_{way}"] * power for lag in ("first", "second")], 0
            )
        )
    swing = {way: float(np.ptp(np.log(line)) + abs(np.mean(np.log(line)))) for way, line in lines.items()}
    influence = {lag: sum(abs(values[f"{lag}_{what}"]) for what in ("direction", "rising", "falling")) for lag in _LAGS}
    middle, low = LEVEL.size // 2, LEVEL.size // 4
    ratio = lines["rising"][middle] / lines["falling"][middle]
    rise, fall = (line[-1] / line[low] for line in lines.values())
    words = (
        f"At half of the torque the speed while it rises is {ratio:.2g} times that while it falls; "
        f"from a quarter of the torque to the full one, that of the rise grows {rise:.2g}-fold and that of the fall "
        f"{fall:.2g}-fold."
    )
    enters = "rate of rise" if swing["rising"] >= swing["falling"] else "rate of fall"
    driven = "activation" if influence["first"] >= influence["second"] else "torque"
    return Shape(enters, driven, words, "torque (share of the largest)", LEVEL, "speed, of the plain model: 1", lines)


_LAGS = ("first", "second")


EFFECT = Effect(
    id="free_speed",
    name="Speed that depends on level and direction",
    forms=tuple(
        Form(
            name,
            "lags",
            "a' = k1 (w - a + κ(a - y)), y' = k2 (a - y); ln k = ln k0 ± direction/2 + power·ln((level + 1/4)/(5/4)), "
            f"each power for rise and fall; {words}",
            tuple(
                Parameter(parameter, "1", -1.5, 1.5, 0.0, (0.0,), about=_ABOUT[parameter.rpartition("_")[2]])
                for parameter in _LAW
            ),
            law=_LAW,
            held=fixed_laws,
        )
        for name, words, fixed_laws in (
            ("quick_first", "the quicker lag first", {}),
            ("slow_first", "the slower lag first", {FreeLaw.SWAPPED: 1.0}),
        )
    ),
    signature="Rise and fall, or low and high levels, differ in speed, and no one ratio describes it.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "free_gate", "free_level"),
    separated_by="Steps up and down between several levels.",
    plain="How quickly the torque follows depends on the level and on the direction: the picture shows how. No effect "
    "of the library describes it.",
    source="two lags with free rates; cf. Winters 1995, Zajac 1989",
    main={"first_direction": "speed of rise over that of fall"},
    shape=_shape,
)
