"""Dynamics whose speed depends on how strongly the muscle works."""

from __future__ import annotations

from dataclasses import replace

from stimrig.identify.dynamics.variable_speed import Lag
from stimrig.identify.dynamics.variable_speed import SpeedLaw as Law
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene


class _TwoLags(Form):
    """A form for two different lags; it is also started from two different lags, in case the base model has none."""

    def starts(self, scene: Scene) -> list[dict[str, float]]:
        return [*super().starts(scene), {"slope": 1.0, "base.damping": 1.25}]


_SLOPE = Parameter("slope", "1", -0.9, 20.0, 0.0, (0.5, -0.35), about="change of one lag from rest to full torque")
_BOUND = "Ding, Wexler, Binder-Macleod 2000: force decays with τ1 + τ2·(bound calcium)"
_ATTACHED = "Campbell 1997: attached bridges help others attach"
_PUMP = "Stein, Bobet, Oğuztöreli, Fryer 1988: uptake of calcium saturates"
_EXPONENTIAL = Form(
    "exponential",
    "speed",
    "T exp(slope·y/y_max)",
    (replace(_SLOPE, lower=-2.0, upper=2.0, about="change of log T from rest to full torque"),),
    law={(Lag.BOTH, Law.EXPONENTIAL): "slope"},
)

EFFECT = Effect(
    id="activation_dependent_speed",
    name="Speed depends on activation",
    forms=(
        _EXPONENTIAL,
        *(
            _TwoLags(f"{name}_{varied}_lag", "speed", equation, (_SLOPE,), law={(lag, law): "slope"}, source=source)
            for lag, varied, other in ((Lag.SLOW, "slow", "quick"), (Lag.QUICK, "quick", "slow"))
            for name, law, source, equation in (
                (
                    "activation",
                    Law.SECOND_ACTIVATION,
                    _BOUND,
                    f"a' = (w - a)/{other}, y' = (a - y)/({varied} (1 + slope·a/y_max))",
                ),
                (
                    "attached",
                    Law.SECOND_ATTACHED,
                    _ATTACHED,
                    f"a' = (w - a)/{other}, y' = (a - y) (1 + slope·y/y_max)/{varied}",
                ),
                (
                    "pump",
                    Law.PUMP,
                    _PUMP,
                    f"a' = (w/(1 + s·w) - a/(1 + s·a))/{varied}, y' = (a - y)/{other}, s = slope/y_max",
                ),
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
