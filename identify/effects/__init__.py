"""The library of physical effects, found in this package, in entry points and in a user's folder.

Each has its own file; the free ones share `terms.py`, which lists them as `EFFECTS`.

A user's own effect is a file with `EFFECT = Effect(...)`, found in the folder named by the environment variable
STIMRIG_EFFECTS_DIR, or through an entry point of the group `stimrig.effects`. See `docs/add-an-effect.md`.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stimrig.identify.effects import own_file
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, form
from stimrig.identify.effects.own_file import BadEffect
from stimrig.identify.errors import BadRequest

FOLDER_VARIABLE = "STIMRIG_EFFECTS_DIR"
GROUP = "stimrig.effects"
TRIAL = """
import faulthandler, os, sys, traceback
place, limit_s, folder, *sys.path = sys.argv[1], float(sys.argv[2]), *sys.argv[3:]
from stimrig.identify import effects
report = open(place, "w", encoding="ascii", errors="backslashreplace")
faulthandler.enable(report)
try:
    faulthandler.dump_traceback_later(limit_s, exit=True, file=report)
    for _ in effects._own_effects(folder, effects.entry_points(group=effects.GROUP)):
        faulthandler.dump_traceback_later(limit_s, exit=True, file=report)
except (Exception, SystemExit):
    pass  # the process that started this one meets it too, and reports it
except BaseException:
    traceback.print_exc(file=report)
    report.flush()
    os._exit(1)
os._exit(effects.TRIED)
"""
"""Program that loads the own effects and ends itself where one of them takes longer than a limit.

It looks for modules where its parent does, not in the current folder. Its report is a file, since a pipe would be kept
open by whatever an effect starts.
"""
TRIED = 77
"""Status with which it ends: an effect may end it with any other."""
TRIAL_S = 20.0
"""Longest time of an own effect, which takes milliseconds: an endless loop would hold up every verb in silence."""


def _library() -> list[Effect]:
    modules = (importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__))
    effects = [getattr(module, "EFFECTS", None) or (getattr(module, "EFFECT", None),) for module in modules]
    return [effect for listed in effects for effect in listed if effect is not None]


@lru_cache(maxsize=8)
def _everything(folder: str) -> dict[str, Effect]:
    effects = {effect.id: effect for effect in _library()}
    places = dict.fromkeys(effects, "the library")
    points = entry_points(group=GROUP)
    if folder or points:
        _try_out(folder)
    for place, effect in _own_effects(folder, points):
        if effect.id in places:
            message = f"the effect {effect.id!r} is also in {places[effect.id]}"
            raise BadEffect(message, place=place, fix="Give it another id.")
        places[effect.id] = place
        effects[effect.id] = effect
    return effects


def _try_out(folder: str) -> None:
    """Load the own effects in another process first: nothing else ends code that catches every exception.

    Raises BadEffect: one of them does not end, or ends the process.
    """
    with TemporaryDirectory(prefix="stimrig-") as there:
        place = Path(there) / "report"
        command = [sys.executable, "-c", TRIAL, str(place), str(TRIAL_S), folder, *sys.path]
        ended = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        text = place.read_text("ascii") if place.exists() else ""
    if ended.returncode != TRIED:
        own = {ascii(str(path.absolute()))[1:-1]: path for path in Path(folder or ".").glob("*.py") if folder}
        frames = re.findall(r'File "(.+)", line (\d+)', text)
        places = [f"{own[file]}, line {line}" for file, line in frames if file in own]
        places += [f"{file}, line {line}" for file, line in frames]
        message = f"not done after {TRIAL_S:g} s" if "Timeout (" in text else "it ends Python"
        raise BadEffect(message, place=[*places, folder or GROUP][0], fix=own_file.FIX)


def _own_effects(folder: str, points: Iterable[EntryPoint]) -> Iterator[tuple[str, Effect]]:
    yield from _from_packages(points)
    if folder:
        yield from _from_folder(Path(folder))


def _from_packages(points: Iterable[EntryPoint]) -> Iterator[tuple[str, Effect]]:
    for point in points:
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

    Raises BadEffect: a user's folder is not there, or one of the files cannot be loaded or used.
    """
    return dict(_everything(os.environ.get(FOLDER_VARIABLE, "")))


def find_effect(effect_id: str) -> Effect:
    """One effect by its id. Raises BadRequest: no effect has this id.

    Parameters
    ----------
    effect_id : str
        As in `Model.effects`.
    """
    effects = registry()
    if effect_id not in effects:
        known = ", ".join(sorted(effects))
        fix = f"If it is one of your own, set {FOLDER_VARIABLE} to the folder with its file. Known: {known}."
        if effect_id.startswith("free_"):
            fix = "Its free effects are terms now. Fit the record again."
        raise BadRequest(f"unknown effect {effect_id!r}", fix=fix)
    return effects[effect_id]


def known_form(entry: Mapping[str, Any]) -> tuple[Effect, Form] | None:
    """The effect and the form of an entry of `Model.effects`; None if either is unknown here.

    Parameters
    ----------
    entry : mapping
        One of `Model.effects`.
    """
    try:
        effect = registry()[entry["id"]]
        return effect, effect.form(entry["form"])
    except KeyError:
        return None


def depend_on_joint(names: Iterable[str]) -> bool:
    """Return True if one of the effects depends on the angle or the velocity of the joint.

    Parameters
    ----------
    names : iterable of str
        Ids of effects.
    """
    return any(find_effect(name).moves_with_joint for name in names)


def library() -> list[dict[str, Any]]:
    """The library as dicts, for `stimrig effects` and the page."""
    return [effect.to_dict() for effect in registry().values()]


__all__ = [
    "BadEffect", "Effect", "Form", "Parameter", "Scene", "depend_on_joint", "find_effect", "form",
    "known_form", "library", "registry",
]  # fmt: skip
