"""Titles of the library's effects and names of their parameters, in the page's language; ids are for programs."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stimrig.api import language
from stimrig.api.language import lazy

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


@cache
def titles() -> dict[str, str]:
    """Titles by id, as `EFFECT = Effect(…)` in the library's files says them.

    The files are read and not loaded: the web process does without their physics, and the centre has no worker to ask.
    """
    spec = find_spec("stimrig.identify.effects")
    assert spec is not None and spec.origin is not None
    found: dict[str, str] = {}
    for path in sorted(Path(spec.origin).parent.glob("*.py")):
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            match line:
                case ast.Assign(targets=[ast.Name("EFFECT")], value=ast.Call(keywords=given)):
                    said = {part.arg: str(part.value.value) for part in given if isinstance(part.value, ast.Constant)}
                    found[said["id"]] = said["name"]
    return found


def effect_words(effect: str) -> str:
    """An effect's title; the id of a person's own effect as words."""
    known = titles().get(effect)
    return effect.replace("_", " ").capitalize() if known is None else language._(known)


def within(effect: str) -> str:
    """A title within a sentence: in English it begins with a small letter."""
    words = effect_words(effect)
    return words[:1].lower() + words[1:] if language.code() == language.DEFAULT else words


def effects_words(effects: Iterable[str]) -> str:
    """Titles, one after the other; each effect may have its form (`fatigue:fitness`)."""
    return ", ".join(_form_words(effect) for effect in effects)


def _form_words(effect: str) -> str:
    identity, _colon, form = effect.partition(":")
    return f"{within(identity)} ({form.replace('_', ' ')})" if form else within(identity)


def without_unit(parameter: str) -> str:
    """A parameter's name without its unit."""
    return parameter.removesuffix(next((end for end in UNITS if parameter.endswith(end)), ""))


def parameter_words(parameter: str) -> str:
    """A parameter's name without its unit, in the page's language where it stands for its effect."""
    name = without_unit(parameter)
    return str(PARAMETERS.get(name) or name.replace("_", " "))
