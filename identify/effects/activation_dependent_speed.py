"""Dynamics whose speed depends on how strongly the muscle works."""

from __future__ import annotations

from stimrig.identify.dynamics.variable_speed import Lag
from stimrig.identify.dynamics.variable_speed import SpeedLaw as Law
from stimrig.identify.effects.base import Effect, Form, Parameter


def _form(name: str, equation: str, lag: Lag, law: Law, lower: float = -0.85, upper: float = 5.0) -> Form:
    slope = Parameter("slope", "1", lower, upper, 0.0, (0.5, -0.35), about="change of T from rest to full torque")
    return Form(name, "speed", equation, (slope,), law={"slope": (lag, law)})


def _two_lags(name: str, equation: str, lag: Lag, law: Law, source: str) -> Form:
    """A form for two different lags; it is also started from two different lags, in case the base model has none."""
    slope = Parameter("slope", "1", -0.9, 20.0, 0.0, (0.5, -0.35), about="change of the lag from rest to full torque")
    apart = ({"slope": 1.0, "base.damping": 1.25},)
    return Form(name, "speed", equation, (slope,), law={"slope": (lag, law)}, restarts=apart, source=source)


_BOUND = "Ding, Wexler, Binder-Macleod 2000: force decays with τ1 + τ2·(bound calcium)"
_ATTACHED = "Campbell 1997: attached bridges help others attach"
_PUMP = "Stein, Bobet, Oğuztöreli, Fryer 1988: uptake of calcium saturates"


EFFECT = Effect(
    id="activation_dependent_speed",
    name="Speed depends on activation",
    forms=(
        _form("torque", "T (1 + slope·y/y_max)", Lag.BOTH, Law.TORQUE),
        _form("drive", "T (1 + slope·w/y_max)", Lag.BOTH, Law.DRIVE),
        _form("exponential", "T exp(slope·y/y_max)", Lag.BOTH, Law.EXPONENTIAL, -2.0, 2.0),
        _form("inverse_torque", "T/(1 + slope·y/y_max)", Lag.BOTH, Law.INVERSE_TORQUE),
        _form("inverse_drive", "T/(1 + slope·w/y_max)", Lag.BOTH, Law.INVERSE_DRIVE),
        _form("slow_lag", "slower lag times (1 + slope·y/y_max)", Lag.SLOW, Law.TORQUE),
        _form("inverse_slow_lag", "slower lag divided by (1 + slope·w/y_max)", Lag.SLOW, Law.INVERSE_DRIVE),
        _form("bound", "slower lag times (1 + slope·1.15 s/(s + 0.15)), s = w/y_max", Lag.SLOW, Law.SATURATING_DRIVE),
        _form("activation", "T (1 + slope·a/y_max), a: the state between the two lags", Lag.BOTH, Law.ACTIVATION),
        _form(
            "calcium_slow_lag",
            "slower lag times (1 + slope·c), c: bound calcium, which follows the stimulation",
            Lag.SLOW,
            Law.CALCIUM,
            -0.9,
            12.0,
        ),
        _form(
            "calcium_quick_lag", "faster lag times (1 + slope·c), c: bound calcium", Lag.QUICK, Law.CALCIUM, -0.9, 12.0
        ),
        *(
            _two_lags(f"{name}_{varied}_lag", f"a' = (w - a)/{other}, y' = (a - y){words}", lag, law, source)
            for lag, varied, other in ((Lag.SLOW, "slow", "fast"), (Lag.QUICK, "quick", "slow"))
            for name, words, law, source in (
                ("activation", f"/({varied} (1 + slope·a/y_max))", Law.SECOND_ACTIVATION, _BOUND),
                ("attached", f"(1 + slope·y/y_max)/{varied}", Law.SECOND_ATTACHED, _ATTACHED),
            )
        ),
        *(
            _two_lags(name, f"a' = (w/(1 + s·w) - a/(1 + s·a))/{lags}, s = slope/y_max", lag, Law.PUMP, _PUMP)
            for name, lags, lag in (
                ("pump_slow_lag", "slow, y' = (a - y)/fast", Lag.SLOW),
                ("pump_quick_lag", "fast, y' = (a - y)/slow", Lag.QUICK),
            )
        ),
    ),
    signature="Small torques develop faster (or slower) than large ones: the sign of the error depends on level and "
    "time.",
    resembles=("asymmetric_relaxation", "voluntary_effort", "mixed_fibres", "output_saturation"),
    separated_by="A PRBS of small amplitude around three or four levels.",
    plain="The muscle is faster or slower when it works hard. One linear model is right at one level only; the "
    "controller should know the speed at each level.",
    source="Hunt, Munih, Donaldson, Barr 1998: speed varied fivefold with level, small-signal gain up to threefold",
    main={"slope": "slope"},
)
