"""Names of effects and of their parameters for people; programs use ids."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

UNITS = (
    "_nm_s_per_rad2", "_s_per_rad", "_per_rad2", "_nm_per_s", "_us_per_s", "_nm_per_rad", "_per_rad", "_per_s", "_nm",
    "_us", "_s", "_hz", "_rad", "_ms",
)  # fmt: skip


@cache
def library() -> dict[str, dict[str, Any]]:
    """Read the constants of each `Effect(…)` in the library, by id; without forms.

    The files are parsed and not imported: the web process does without their physics.
    """
    spec = find_spec("stimrig.identify.effects")
    assert spec is not None and spec.origin is not None
    effects: dict[str, dict[str, Any]] = {}
    for path in sorted(Path(spec.origin).parent.glob("*.py")):
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            match line:
                case ast.Assign(value=ast.Call(func=ast.Name("Effect"), keywords=keywords)):
                    plain = [part for part in keywords if isinstance(part.value, ast.Constant | ast.Dict)]
                    values = {str(part.arg): ast.literal_eval(part.value) for part in plain}
                    effects[values["id"]] = values
    return effects


def fact_of(effect: str, key: str, otherwise: Any) -> Any:
    """Return a value of an effect's file; `otherwise` where it has none, or the effect is a person's own."""
    return library().get(effect, {}).get(key, otherwise)


@cache
def _short_names() -> dict[str, str]:
    """Return the names of main parameters, by parameter without its unit."""
    return {without_unit(key): words for effect in library().values() for key, words in effect.get("main", {}).items()}


def effect_words(effect: str) -> str:
    """Return an effect's title; the id of a term or of a person's own effect as words."""
    return fact_of(effect, "name", "") or effect.removeprefix("free_").replace("_", " ").capitalize()


def within(effect: str) -> str:
    """Return a title as it is written within a sentence."""
    words = effect_words(effect)
    return words[:1].lower() + words[1:]


def effects_words(effects: Iterable[str], without_evidence: Collection[str] = ()) -> str:
    """Join titles, those added without evidence marked; an effect's form (`fatigue:fitness`) is left out."""
    named = ((effect, within(effect.partition(":")[0])) for effect in effects)
    return ", ".join(f"{words} (without evidence)" if effect in without_evidence else words for effect, words in named)


def without_unit(parameter: str) -> str:
    """Return a parameter's name without its unit."""
    return parameter.removesuffix(next((end for end in UNITS if parameter.endswith(end)), ""))


def parameter_words(parameter: str) -> str:
    """Return a parameter's name for people, without its unit."""
    name = without_unit(parameter)
    return _short_names().get(name, name.replace("_", " "))
