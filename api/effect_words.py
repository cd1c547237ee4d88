"""Titles of the library's effects and names of their parameters, in the page's language; ids are for programs.

The same titles stand in `stimrig.identify.effects`, which the web process does not load (a test compares them).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from stimrig.api import language
from stimrig.api.language import lazy

EFFECTS: dict[str, Any] = {
    "activation_dependent_speed": lazy("Speed depends on activation"),
    "asymmetric_relaxation": lazy("Contraction and relaxation differ in speed"),
    "baseline_drift": lazy("Drift of the baseline"),
    "catch_like": lazy("Catch-like boost at the onset of a train"),
    "electromechanical_delay": lazy("Electromechanical delay"),
    "fatigue": lazy("Fatigue"),
    "mains_hum": lazy("Mains hum"),
    "mixed_fibres": lazy("Fast and slow fibres in parallel"),
    "output_saturation": lazy("Saturation of the output"),
    "passive_torque": lazy("Passive torque of the joint"),
    "potentiation": lazy("Potentiation"),
    "recruitment_hysteresis": lazy("Hysteresis of recruitment"),
    "sensor_clipping": lazy("Clipping of the sensor"),
    "series_compliance": lazy("Compliance in series"),
    "threshold_drift": lazy("Drift of the recruitment threshold"),
    "torque_angle": lazy("Torque depends on angle"),
    "torque_velocity": lazy("Torque depends on velocity"),
    "tremor": lazy("Tremor"),
    "voluntary_effort": lazy("Voluntary effort or spasm"),
}
PARAMETERS: dict[str, Any] = {
    "bend_1": lazy("slope over the angle"),
    "ceiling": lazy("ceiling"),
    "delay": lazy("delay"),
    "depth": lazy("depth"),
    "elastic_1": lazy("elastic torque over the angle"),
    "fall": lazy("time constant of relaxation"),
    "floor": lazy("floor"),
    "frequency": lazy("frequency"),
    "gain": lazy("gain"),
    "gain_0": lazy("gain at the first knot"),
    "gap_0": lazy("gap at small widths"),
    "half_width": lazy("half width"),
    "height_0": lazy("peak torque"),
    "knee": lazy("knee"),
    "knot_1": lazy("first shift"),
    "lag": lazy("spread of the delays"),
    "period": lazy("period"),
    "ratio": lazy("ratio"),
    "resonance": lazy("resonance"),
    "share": lazy("share"),
    "sharpness": lazy("sharpness"),
    "shift": lazy("shift"),
    "slope": lazy("slope"),
    "slow_share": lazy("share of slow fibres"),
    "stiffness": lazy("stiffness"),
}
"""The parameters that stand for an effect in the trend, without their units."""
UNITS = (
    "_nm_s_per_rad2", "_s_per_rad", "_per_rad2", "_nm_per_s", "_us_per_s", "_nm_per_rad", "_per_rad", "_per_s", "_nm",
    "_us", "_s", "_hz", "_rad", "_ms",
)  # fmt: skip


def effect_words(effect: str) -> str:
    """An effect's title; the id of a person's own effect as words."""
    known = EFFECTS.get(effect)
    return str(known) if known is not None else effect.replace("_", " ").capitalize()


def within(effect: str) -> str:
    """A title within a sentence: in English it begins with a small letter."""
    words = effect_words(effect)
    return words[:1].lower() + words[1:] if language.code() == language.DEFAULT else words


def effects_words(effects: Iterable[str]) -> str:
    """Titles, one after the other; each effect may have its form (`fatigue:fitness`)."""
    return ", ".join(_with_form(effect) for effect in effects)


def _with_form(effect: str) -> str:
    identity, _colon, form = effect.partition(":")
    return f"{within(identity)} ({form.replace('_', ' ')})" if form else within(identity)


def without_unit(parameter: str) -> str:
    """A parameter's name without its unit."""
    return parameter.removesuffix(next((end for end in UNITS if parameter.endswith(end)), ""))


def parameter_words(parameter: str) -> str:
    """A parameter's name without its unit, in the page's language where it stands for its effect."""
    name = without_unit(parameter)
    return str(PARAMETERS.get(name) or name.replace("_", " "))
