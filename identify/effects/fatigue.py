"""Muscle fatigue: the gain falls during use and recovers at rest."""

from __future__ import annotations

from functools import partial

from stimrig.identify.effects.base import Effect, Parameter, slow_gain

_DEPTH = Parameter("depth", "1", 0.0, 0.95, 0.0, (0.3, 0.6), about="largest share of torque that is lost")
_ONSET = Parameter("onset_s", "s", 3.0, 250.0, 30.0, (15.0, 50.0), "log", about="time constant under full stimulation")
_RECOVERY = Parameter("recovery_s", "s", 4.0, 400.0, 50.0, (40.0, 90.0), "log", about="time constant at rest")
_form = partial(slow_gain, "fatigue", (_DEPTH, _ONSET, _RECOVERY), lambda p, x: 1.0 - p["depth"] * x)

EFFECT = Effect(
    id="fatigue",
    name="Fatigue",
    forms=(
        _form(
            "fitness",
            "w = μ f(u); μ = 1 - depth·x; x' = a(1 - x)/onset - (1 - a) x/recovery; a = |f|/f_max",
            source="Riener, Quintern, Schmidt 1996, muscle fitness",
        ),
        _form(
            "by_pulses",
            "w = μ f(u); μ = 1 - depth·x; x' = a(1 - x)/onset - (1 - a) x/recovery; a = 1 under pulses of any width, "
            "else 0",
            by_pulses=True,
        ),
    ),
    signature="Torque above the model early in the stimulation and below it late; after a rest it is higher again.",
    resembles=("threshold_drift", "potentiation", "baseline_drift"),
    separated_by="The ramp repeated after stimulation, and once more after a rest.",
    plain="The muscle tires: the longer it has worked, the less torque the same pulse gives. It recovers at rest. "
    "After a stroke, muscles tire sooner. Late in a session the muscle needs more charge, or longer rests.",
    source="Riener et al. 1996",
    main={"depth": "depth"},
)
