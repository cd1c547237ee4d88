"""The library of physical effects: one file each, found in this package, in entry points and in a user's folder.

A user's own effect is a file with `EFFECT = Effect(...)`, found in the folder named by the environment variable
STIMRIG_EFFECTS_DIR, or through an entry point of the group `stimrig.effects`. See `docs/add-an-effect.md`.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from stimrig.identify.effects import own_file
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene
from stimrig.identify.effects.own_file import BadEffect
from stimrig.identify.errors import BadRequest

FOLDER_VARIABLE = "STIMRIG_EFFECTS_DIR"
GROUP = "stimrig.effects"
_NOT_EFFECTS = {"base", "kernels", "own_file"}


def _own() -> list[Effect]:
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if m.name not in _NOT_EFFECTS)
    return [importlib.import_module(f"{__name__}.{name}").EFFECT for name in names]


@lru_cache(maxsize=8)
def _everything(folder: str) -> dict[str, Effect]:
    found = {effect.id: effect for effect in _own()}
    added = [*_from_packages(), *(_from_folder(Path(folder)) if folder else ())]
    places: dict[str, str] = {}
    for place, effect in added:
        if effect.id in places:
            message = f"the effect {effect.id!r} is also in {places[effect.id]}"
            raise BadEffect(message, place=place, fix="Give one of them another id.")
        places[effect.id] = place
        found[effect.id] = effect
    return found


def _from_packages() -> Iterator[tuple[str, Effect]]:
    for point in entry_points(group=GROUP):
        place = f"entry point {point.name} = {point.value}"
        try:
            effect = point.load()
        except Exception as error:
            raise BadEffect(own_file.in_one_line(error), place=place, fix=own_file.FIX) from error
        yield place, own_file.checked(effect, place)


def _from_folder(folder: Path) -> Iterator[tuple[str, Effect]]:
    if not folder.is_dir():
        what = "a file, not a folder" if folder.exists() else "no such folder"
        raise BadEffect(what, place=f"{FOLDER_VARIABLE}={folder}", fix="Name the folder that holds the effects' files.")
    for path in sorted(folder.glob("*.py")):
        yield str(path), own_file.effect_of(path)


def registry() -> dict[str, Effect]:
    """All effects by id: the library's, those of entry points, those in the user's folder.

    Raises
    ------
    BadEffect
        A user's folder is not there, or one of the files cannot be loaded or used.
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
        "part": effect.part,
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
