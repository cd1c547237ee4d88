"""What the library's effects say of themselves to people; ids are for programs."""

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
    """What the library's effects say of themselves in `EFFECT = Effect(…)`, by id; no forms.

    The files are read and not loaded: the web process does without their physics.
    """
    spec = find_spec("stimrig.identify.effects")
    assert spec is not None and spec.origin is not None
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(Path(spec.origin).parent.glob("*.py")):
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            match line:
                case ast.Assign(targets=[ast.Name(name)], value=ast.Call(keywords=given)) if name == "EFFECT":
                    plain = [part for part in given if isinstance(part.value, ast.Constant | ast.Dict)]
                    said = {str(part.arg): ast.literal_eval(part.value) for part in plain}
                    found[said["id"]] = said
    return found


def fact_of(effect: str, key: str, otherwise: Any) -> Any:
    """What an effect says of itself in its file; `otherwise` where it says nothing, or is a person's own."""
    return library().get(effect, {}).get(key, otherwise)


@cache
def _short_names() -> dict[str, str]:
    """The parameters that stand for their effects, without their units."""
    return {without_unit(key): words for effect in library().values() for key, words in effect.get("main", {}).items()}


def effect_words(effect: str) -> str:
    """An effect's title; the id of a person's own effect as words."""
    return fact_of(effect, "name", "") or effect.replace("_", " ").capitalize()


def within(effect: str) -> str:
    """A title within a sentence: in English it begins with a small letter."""
    words = effect_words(effect)
    return words[:1].lower() + words[1:]


def effects_words(effects: Iterable[str], without_evidence: Collection[str] = ()) -> str:
    """Titles, one after the other, those added without evidence marked; of an effect's form (`fatigue:fitness`) people
    are told nothing."""
    named = ((effect, within(effect.partition(":")[0])) for effect in effects)
    return ", ".join(f"{words} (without evidence)" if effect in without_evidence else words for effect, words in named)


def without_unit(parameter: str) -> str:
    """A parameter's name without its unit."""
    return parameter.removesuffix(next((end for end in UNITS if parameter.endswith(end)), ""))


def parameter_words(parameter: str) -> str:
    """A parameter's name without its unit where it stands for its effect."""
    name = without_unit(parameter)
    known = _short_names().get(name)
    return name.replace("_", " ") if known is None else known
