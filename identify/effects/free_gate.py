"""A free effect: pulses open a gate, their width says how much passes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Shape

TIME_S = np.linspace(0.0, 0.5, 101)
STOPS_S = 0.25
SLOWS = 0.3
"""Log of the change of speed above which the gate is described as one of speed, not of the drive: a third."""


def _shape(_form: Form, values: Mapping[str, float]) -> Shape:
    lag_s, bend = values["gate_s"], values["bend"]
    opened = 1.0 - (1.0 + TIME_S / lag_s) * np.exp(-TIME_S / lag_s)
    after = np.maximum(TIME_S - STOPS_S, 0.0)
    bound = opened - (1.0 - (1.0 + after / lag_s) * np.exp(-after / lag_s))
    gate = (1.0 + bend) * bound / (1.0 + bend * bound)
    rate = np.exp(values["gate_rate"] * gate)
    half_s = float(np.interp(0.5, gate[TIME_S <= STOPS_S], TIME_S[TIME_S <= STOPS_S]))
    stays_s = float(np.max(TIME_S[gate > 0.5], initial=STOPS_S)) - STOPS_S
    words = (
        f"Pulses open a gate, half of it within {1000.0 * half_s:.0f} ms, and it stays half open for "
        f"{1000.0 * stays_s:.0f} ms after the last one; open, the muscle has {np.exp(values['gate_rate']):.2g} times "
        "the speed that it has closed."
    )
    enters = "rate of fall" if abs(values["gate_rate"]) > SLOWS else "drive"
    axes = "time, pulses for 0.25 s, then none (s)", TIME_S, "opening and speed"
    return Shape(enters, "time since", words, *axes, {"opening": gate, "speed": rate})


EFFECT = Effect(
    id="free_gate",
    name="A gate that pulses open",
    forms=(
        Form(
            "two_lags",
            "lags",
            "w = γ f(u of the last pulse); γ = (1 + bend) c/(1 + bend·c); c follows the presence of pulses by two lags "
            "of gate_s; both rates · exp(gate_rate·γ)",
            (
                Parameter("gate_s", "s", 0.004, 0.12, 0.0, (0.02, 0.04), "log", about="time constant of either lag"),
                Parameter("bend", "1", -0.8, 12.0, 0.0, (1.0, 3.0), about="saturation"),
                Parameter("gate_rate", "1", -2.5, 2.5, 0.0, (-0.5,), about="log speed of the open muscle"),
            ),
            law={"gate_s": FreeLaw.GATE_S, "bend": FreeLaw.BEND, "gate_rate": FreeLaw.GATE_RATE},
        ),
    ),
    signature="The start and the end of a train differ from changes of width within it.",
    resembles=("catch_like", "asymmetric_relaxation", "free_speed"),
    separated_by="Jumps of width within a train, beside trains that begin and end.",
    plain="That pulses come, and how wide they are, act in different ways: the picture shows how the first ones open "
    "the muscle. No effect of the library describes it.",
    source="cf. calcium and its binding in Ding et al. 2003",
    main={"gate_s": "time to open"},
    shape=_shape,
)
