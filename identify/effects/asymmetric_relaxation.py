"""Different time constants for the development and the decay of torque."""

from __future__ import annotations

from stimrig.identify.dynamics.variable_speed import Lag, SpeedLaw
from stimrig.identify.effects.base import Effect, Form, Parameter

_RATIO = Parameter(
    "ratio", "1", 0.12, 8.0, 1.0, (1.6, 0.6), "log", about="time constant of decay divided by that of development"
)
_POWER = Parameter("power", "1", 0.1, 2.0, 0.0, (0.5, 1.0), about="influence of the level")


def _form(name: str, words: str, lag: Lag) -> Form:
    equation = f"{words}·ratio while the drive is below the torque, else {words}"
    return Form(name, "speed", equation, (_RATIO,), law={(lag, SpeedLaw.RATIO): "ratio"})


def _by_level(name: str, words: str, lag: Lag) -> Form:
    return Form(
        name,
        "speed",
        f"{words}·ratio·c^-power while the drive is below the torque, else {words}·c^power; c = 0.5 + 1.5 y/y_max",
        (_RATIO, _POWER),
        law={(lag, SpeedLaw.RATIO): "ratio", (lag, SpeedLaw.LEVEL): "power"},
        source="Winters 1995; Thelen 2003",
    )


EFFECT = Effect(
    id="asymmetric_relaxation",
    name="Contraction and relaxation differ in speed",
    forms=(
        _form("by_drive", "T", Lag.BOTH),
        _form("slow_lag", "slower lag", Lag.SLOW),
        _by_level("by_level", "T", Lag.BOTH),
        _by_level("slow_lag_by_level", "slower lag", Lag.SLOW),
    ),
    signature="Torque above the model when it rises and below it when it falls, or the reverse, after every change.",
    resembles=("output_saturation", "activation_dependent_speed", "catch_like", "mixed_fibres"),
    separated_by="Steps on and off at several levels.",
    plain="The muscle does not relax at the same speed as it contracts. A stroke can change either of the two. A "
    "controller that uses one speed reacts too late in one direction.",
    source="McCrea, Eng, Hodgson 2003 (development and decay impaired independently); Thelen 2003",
    main={"ratio": "ratio"},
)
