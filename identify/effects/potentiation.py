"""Potentiation: the gain grows with use, before fatigue begins."""

from __future__ import annotations

from functools import partial

from stimrig.identify.effects.base import Effect, Parameter, slow_gain

_GAIN = Parameter("gain", "1", 0.0, 2.0, 0.0, (0.2, 0.5), about="largest share of torque that is gained")
_ONSET = Parameter("onset_s", "s", 1.2, 80.0, 5.0, (4.0, 15.0), "log", about="time constant under full stimulation")
_RECOVERY = Parameter("recovery_s", "s", 2.0, 400.0, 60.0, (20.0, 80.0), "log", about="time constant at rest")
_form = partial(slow_gain, "potentiation", (_GAIN, _ONSET, _RECOVERY), lambda p, x: 1.0 + p["gain"] * x)

EFFECT = Effect(
    id="potentiation",
    name="Potentiation",
    forms=(
        _form("by_level", "w = (1 + gain·x) f(u); x' = a(1 - x)/onset - (1 - a) x/recovery; a = |f|/f_max"),
        _form("by_pulses", "as by_level, with a = 1 under pulses of any width, else 0", by_pulses=True),
    ),
    signature="Torque below the model early in the stimulation and above it late: the opposite of fatigue.",
    resembles=("threshold_drift", "fatigue", "baseline_drift"),
    separated_by="The ramp after a conditioning train, and once more after a rest.",
    plain="The muscle warms up: after some seconds of work the same pulse gives more torque. Within about a minute of "
    "rest this gain is lost. A short conditioning train before the session makes the response repeatable.",
    source="O'Leary, Hope, Sale 1997: twitch +45 % at 5 s and +28 % at 1 min after 7 s at 100 Hz",
    main={"gain": "gain"},
)
