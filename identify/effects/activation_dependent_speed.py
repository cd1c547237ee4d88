"""Dynamics whose speed depends on how strongly the muscle works."""

from __future__ import annotations

from stimrig.identify.dynamics.variable_speed import Lag
from stimrig.identify.dynamics.variable_speed import SpeedLaw as Law
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene


class _TwoLags(Form):
    """A form for two different lags; it is also started from two different lags, in case the base model has none."""

    def starts(self, scene: Scene) -> list[dict[str, float]]:
        return [*super().starts(scene), {"slope": 1.0, "base.damping": 1.25}]


def _form(
    name: str,
    equation: str,
    lag: Lag,
    law: Law,
    bounds: tuple[float, float] = (-0.85, 5.0),
    source: str = "",
    kind: type[Form] = Form,
) -> Form:
    about = "change of T, or of one lag, from rest to full torque"
    slope = Parameter("slope", "1", *bounds, 0.0, (0.5, -0.35), about=about)
    return kind(name, "speed", equation, (slope,), law={(lag, law): "slope"}, source=source)


_BOUND = "Ding, Wexler, Binder-Macleod 2000: force decays with τ1 + τ2·(bound calcium)"
_ATTACHED = "Campbell 1997: attached bridges help others attach"
_PUMP = "Stein, Bobet, Oğuztöreli, Fryer 1988: uptake of calcium saturates"
_CALCIUM, _LAG = (-0.9, 12.0), (-0.9, 20.0)


EFFECT = Effect(
    id="activation_dependent_speed",
    name="Speed depends on activation",
    forms=(
        _form("torque", "T (1 + slope·y/y_max)", Lag.BOTH, Law.TORQUE),
        _form("drive", "T (1 + slope·w/y_max)", Lag.BOTH, Law.DRIVE),
        _form("exponential", "T exp(slope·y/y_max)", Lag.BOTH, Law.EXPONENTIAL, (-2.0, 2.0)),
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
            _CALCIUM,
        ),
        _form(
            "calcium_quick_lag", "faster lag times (1 + slope·c), c: bound calcium", Lag.QUICK, Law.CALCIUM, _CALCIUM
        ),
        *(
            _form(
                f"{name}_{varied}_lag", f"a' = (w - a)/{other}, y' = (a - y){words}", lag, law, _LAG, source, _TwoLags
            )
            for lag, varied, other in ((Lag.SLOW, "slow", "fast"), (Lag.QUICK, "quick", "slow"))
            for name, words, law, source in (
                ("activation", f"/({varied} (1 + slope·a/y_max))", Law.SECOND_ACTIVATION, _BOUND),
                ("attached", f"(1 + slope·y/y_max)/{varied}", Law.SECOND_ATTACHED, _ATTACHED),
            )
        ),
        *(
            _form(
                f"pump_{varied}_lag",
                f"a' = (w/(1 + s·w) - a/(1 + s·a))/{first}, y' = (a - y)/{second}, s = slope/y_max",
                lag,
                Law.PUMP,
                _LAG,
                _PUMP,
                _TwoLags,
            )
            for lag, varied, first, second in ((Lag.SLOW, "slow", "slow", "fast"), (Lag.QUICK, "quick", "fast", "slow"))
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
