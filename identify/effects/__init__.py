"""The library of physical effects: one file each, found in this package, in entry points and in a user's folder.

A user's own effect is a file with `EFFECT = Effect(...)`, found in the folder named by the environment variable
STIMRIG_EFFECTS_DIR, or through an entry point of the group `stimrig.effects`. See `docs/add-an-effect.md`.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from identify.effects.base import Effect, Form, Parameter, Scene
from identify.errors import BadRequest, IdentifyError

FOLDER_VARIABLE = "STIMRIG_EFFECTS_DIR"
GROUP = "stimrig.effects"
_NOT_EFFECTS = {"base", "kernels", "shapes"}


class BadEffect(IdentifyError):
    """A user's effect cannot be loaded, or does not do what an effect must."""


def _own() -> list[Effect]:
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if m.name not in _NOT_EFFECTS)
    return [importlib.import_module(f"{__name__}.{name}").EFFECT for name in names]


def _from_file(path: Path) -> Effect:
    spec = importlib.util.spec_from_file_location(f"stimrig_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise BadEffect("not a Python file", place=str(path))
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        effect = module.EFFECT
    except Exception as error:
        raise BadEffect(
            f"{type(error).__name__}: {error}", place=str(path), fix="See docs/add-an-effect.md."
        ) from error
    return effect


@lru_cache(maxsize=8)
def _everything(folder: str) -> dict[str, Effect]:
    found = {effect.id: effect for effect in _own()}
    for point in entry_points(group=GROUP):
        effect = point.load()
        found[effect.id] = effect
    if folder:
        for path in sorted(Path(folder).glob("*.py")):
            effect = _from_file(path)
            found[effect.id] = effect
    return found


def registry() -> dict[str, Effect]:
    """All effects by id: the library's, those of entry points, those in the user's folder.

    Raises
    ------
    BadEffect
        A user's file cannot be loaded.
    """
    return dict(_everything(os.environ.get(FOLDER_VARIABLE, "")))


def get(effect_id: str) -> Effect:
    """One effect by its id.

    Raises
    ------
    BadRequest
        No effect has this id.
    """
    effects = registry()
    if effect_id not in effects:
        raise BadRequest(f"unknown effect {effect_id!r}", fix=f"Known: {', '.join(sorted(effects))}.")
    return effects[effect_id]


def library() -> list[dict[str, Any]]:
    """The library as dicts, for `stimrig effects` and the page."""
    return [_describe(effect) for effect in registry().values()]


def _describe(effect: Effect) -> dict[str, Any]:
    first = effect.forms[0]
    return {
        "id": effect.id,
        "name": effect.name,
        "stage": effect.stage,
        "equation": first.equation,
        "parameters": [_parameter(p) for p in first.parameters],
        "forms": [
            {
                "name": form.name,
                "stage": form.stage,
                "equation": form.equation,
                "parameters": [_parameter(p) for p in form.parameters],
                "source": form.source or effect.source,
            }
            for form in effect.forms
            if len(form.parameters) < 40
        ],
        "source": effect.source,
        "signature": effect.signature,
        "confused_with": list(effect.resembles),
        "separated_by": effect.separated_by,
        "plain": effect.plain,
        "needs": list(effect.needs),
        "predictable": effect.predictable,
    }


def _parameter(p: Parameter) -> dict[str, Any]:
    return {
        "name": p.name,
        "unit": p.unit,
        "range": [p.lower, p.upper],
        "relative_to": p.relative or None,
        "neutral": None if p.neutral in (float("inf"), float("-inf")) else p.neutral,
        "start": list(p.start),
        "about": p.about,
    }


__all__ = ["BadEffect", "Effect", "Form", "Parameter", "Scene", "get", "library", "registry"]
