"""Different time constants for the development and the decay of torque."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.variable_speed import Lag, SpeedLaw, activate
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values, form

_LAGS = (
    Parameter("rise_s", "s", 0.0, 0.35, 0.0, (0.02, 0.1), about="activation"),
    Parameter("fall_s", "s", 0.0, 0.35, 0.0, (0.08, 0.03), about="deactivation"),
)
_RATIO = Parameter(
    "ratio", "1", 0.12, 8.0, 1.0, (1.6, 0.6), "log", about="time constant of decay divided by that of development"
)


@form(
    "gain",
    "a' = (w - a)/τ, τ = rise if w > a, else fall; a drives the linear dynamics",
    *_LAGS,
    source="Winters, Stark 1985; Thelen 2003: activation 10 ms, deactivation 40 ms",
)
def kinetics(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return activate(np.ascontiguousarray(drive), p["rise_s"][:, 0], p["fall_s"][:, 0], scene.step_s)


@form(
    "gain",
    "a' = (w - a)/τ, τ = rise (0.5 + 1.5 a) if w > a, else fall/(0.5 + 1.5 a)",
    *_LAGS,
    source="Winters 1995; Thelen 2003",
)
def kinetics_by_level(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    lags = p["rise_s"][:, 0], p["fall_s"][:, 0]
    if not np.any(lags):
        return drive
    return activate(np.ascontiguousarray(drive), *lags, scene.step_s, scene.scale_nm)


EFFECT = Effect(
    id="asymmetric_relaxation",
    name="Contraction and relaxation differ in speed",
    forms=(
        *(
            Form(name, "speed", words, (_RATIO,), law={(lag, law): "ratio"})
            for name, words, lag, law in (
                ("by_drive", "T·ratio while the drive is below the torque, else T", Lag.BOTH, SpeedLaw.RATIO_BY_DRIVE),
                ("by_rate", "T·ratio while the torque falls, else T", Lag.BOTH, SpeedLaw.RATIO_BY_RATE),
                ("slow_lag", "slower lag·ratio while the drive is below the torque", Lag.SLOW, SpeedLaw.RATIO_BY_DRIVE),
                ("slow_lag_by_rate", "slower lag·ratio while the torque falls", Lag.SLOW, SpeedLaw.RATIO_BY_RATE),
                (
                    "quick_lag",
                    "faster lag·ratio while the drive is below the torque",
                    Lag.QUICK,
                    SpeedLaw.RATIO_BY_DRIVE,
                ),
                ("quick_lag_by_rate", "faster lag·ratio while the torque falls", Lag.QUICK, SpeedLaw.RATIO_BY_RATE),
            )
        ),
        *(
            Form(
                name,
                "speed",
                f"{lag_name}·ratio·c^-power while the drive is below the torque, else {lag_name}·c^power; "
                "c = 0.5 + 1.5 y/y_max",
                (_RATIO, Parameter("power", "1", 0.1, 2.0, 0.0, (0.5, 1.0), about="influence of the level")),
                law={(lag, SpeedLaw.RATIO_BY_DRIVE): "ratio", (lag, SpeedLaw.LEVEL): "power"},
                source="Winters 1995; Thelen 2003",
            )
            for name, lag_name, lag in (("by_level", "T", Lag.BOTH), ("slow_lag_by_level", "slower lag", Lag.SLOW))
        ),
        kinetics,
        kinetics_by_level,
    ),
    signature="Torque above the model when it rises and below it when it falls, or the reverse, after every change.",
    resembles=("output_saturation", "activation_dependent_speed", "catch_like", "mixed_fibres"),
    separated_by="Steps on and off at several levels.",
    plain="The muscle does not relax at the same speed as it contracts. A stroke can change either of the two. A "
    "controller that uses one speed reacts too late in one direction.",
    source="McCrea, Eng, Hodgson 2003 (development and decay impaired independently); Thelen 2003",
    main={"ratio": "ratio", "fall_s": "time constant of relaxation"},
)
