"""Dynamics whose speed depends on how strongly the muscle works."""

from __future__ import annotations

from identify.effects.base import Effect, Form, Parameter


def _form(name: str, equation: str, column: int, lower: float = -0.85, upper: float = 5.0) -> Form:
    slope = Parameter("slope", "1", lower, upper, 0.0, (0.5, -0.35), about="change of T from rest to full torque")
    return Form(name, "speed", equation, (slope,), law={"slope": column})


EFFECT = Effect(
    id="activation_dependent_speed",
    name="Speed depends on activation",
    forms=(
        _form("torque", "T (1 + slope·y/y_max)", 2),
        _form("drive", "T (1 + slope·w/y_max)", 3),
        _form("exponential", "T exp(slope·y/y_max)", 4, -2.0, 2.0),
        _form("inverse_torque", "T/(1 + slope·y/y_max)", 5),
        _form("inverse_drive", "T/(1 + slope·w/y_max)", 6),
        _form("slow_lag", "slower of the two lags times (1 + slope·y/y_max)", 7),
        _form("inverse_slow_lag", "slower of the two lags over (1 + slope·w/y_max)", 9),
        _form("bound", "slower of the two lags times (1 + slope·1.15 s/(s + 0.15)), s = w/y_max", 13),
        _form("activation", "T (1 + slope·a/y_max), a the state between the two lags", 11),
        _form("activation_slow_lag", "slower of the two lags times (1 + slope·a/y_max)", 10),
        _form(
            "calcium_slow_lag",
            "slower lag times (1 + slope·c), c bound calcium: c follows the stimulation",
            18,
            -0.9,
            12.0,
        ),
        _form("calcium_quick_lag", "quicker lag times (1 + slope·c), c bound calcium", 19, -0.9, 12.0),
        _form("activation_quick_lag", "quicker of the two lags times (1 + slope·a/y_max)", 14, -0.85, 12.0),
    ),
    signature="Small torques come faster (or slower) than large ones: the error's sign goes with level and time.",
    resembles=("asymmetric_relaxation", "voluntary_effort", "mixed_fibres", "output_saturation"),
    separated_by="A small PRBS around three or four levels.",
    plain="The muscle is quicker, or slower, when it works hard. One linear model can be right at one level only; the "
    "controller should know the speed at each.",
    source="Hunt, Munih, Donaldson, Barr 1998: speed varied fivefold with level, small-signal gain up to threefold",
    experiment=("multilevel", "staircase"),
)
