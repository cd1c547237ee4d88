"""A user's own effect from its file: loaded and tried at once, so that an error names its file and line."""

from __future__ import annotations

import importlib.util
import re
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.effects.base import JOINT_COLUMNS, STAGES, Effect, Form, Parameter, Scene
from stimrig.identify.errors import IdentifyError

FIX = "See docs/add-an-effect.md."
SCALES = ("linear", "log")
RELATIVE = ("", "torque", "width", "span", "level")
OWN_STAGES = tuple(stage for stage in STAGES if stage not in ("speed", "lags"))
"""The laws of the two others are compiled, and those of the library alone."""
ID = r"[a-z][a-z0-9_]{0,63}"
ROWS = 80
"""Pulse intervals on which a form is tried."""
MAX_STARTS = 32
"""Each is a fit."""
Faults = Iterator[tuple[str, str]]
"""What is wrong, and what to do."""


class BadEffect(IdentifyError):
    """A user's effect that can't be loaded or doesn't keep its promises."""


def effect_of(path: Path) -> Effect:
    """The effect of a file. Raises BadEffect: with the file, the line where there is one, and what to do."""
    spec = importlib.util.spec_from_file_location(f"stimrig_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise BadEffect("not a Python file", place=str(path), fix=FIX)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise BadEffect(in_one_line(error), place=_place(path, error), fix=FIX) from error
    if not hasattr(module, "EFFECT"):
        raise BadEffect("no EFFECT in it", place=str(path), fix="End the file with EFFECT = Effect(...).")
    return checked(module.EFFECT, str(path), path)


def in_one_line(error: BaseException) -> str:
    """An error of somebody's code in one line."""
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}: {' '.join(message.split())[:200]}"


def _place(path: Path, error: BaseException) -> str:
    """The file and the line in it at which an error arose."""
    itself = str(path.absolute())  # the loader's name for it, also where the folder is named from here
    if isinstance(error, SyntaxError) and error.filename == itself and error.lineno:
        return f"{path}, line {error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == itself]
    return f"{path}, line {lines[-1]}" if lines else str(path)


def checked(effect: Any, place: str, path: Path | None = None) -> Effect:
    """An effect that can be fitted. Raises BadEffect: what of it cannot be."""
    _refuse(place, _effect_faults(effect))
    for form in effect.forms:
        where = f"{place}, form {form.name!r}"
        _refuse(where, _form_faults(form))
        for parameter in form.parameters:
            _refuse(f"{where}, parameter {parameter.name!r}", _parameter_faults(parameter))
        if form.stage not in ("branch", "filter"):
            _try_out(form, where, path)
    return effect


def _refuse(place: str, faults: Faults) -> None:
    for message, fix in faults:
        raise BadEffect(message, place=place, fix=fix)


def _effect_faults(effect: Any) -> Faults:
    if not isinstance(effect, Effect):
        yield f"EFFECT is a {type(effect).__name__}, not an Effect", "Give EFFECT = Effect(...)."
    if not isinstance(effect.id, str) or not re.fullmatch(ID, effect.id):
        yield f"id {effect.id!r}", "Use small letters, digits and _, beginning with a letter."
    if not effect.forms or not _is_tuple_of(effect.forms, Form):
        yield "forms is no tuple of Form", "Give forms=(Form(...),), with a comma before the closing bracket."
    if not isinstance(effect.needs, tuple) or not JOINT_COLUMNS.issuperset(effect.needs):
        columns = " and ".join(sorted(JOINT_COLUMNS))
        yield f"needs {effect.needs!r}", f"Give a tuple of {columns}, or leave it out."
    if not isinstance(effect.prior, (int, float)) or not np.isfinite(effect.prior):
        yield f"prior {effect.prior!r}", "Give a finite number."
    if twice := _repeated([form.name for form in effect.forms]):
        yield f"two forms are called {twice[0]!r}", "Name each form once."


def _form_faults(form: Form) -> Faults:
    if form.stage not in OWN_STAGES:
        yield f"no stage is called {form.stage!r}", f"Give one of {', '.join(OWN_STAGES)}."
    if not _is_tuple_of(form.parameters, Parameter):
        fix = "Give parameters=(Parameter(...),), with a comma before the closing bracket."
        yield "parameters is no tuple of Parameter", fix
    names = [parameter.name for parameter in form.parameters]
    if wrong := [name for name in (form.name, *names) if not isinstance(name, str)]:
        yield f"a name that is {wrong[0]!r}", "Give a text."
    if twice := _repeated(names):
        yield f"two parameters are called {twice[0]!r}", "Name each parameter once."
    if form.apply is None:
        yield "no apply", "Give apply=, a function of (x, p, scene)."


def _parameter_faults(parameter: Parameter) -> Faults:
    if parameter.scale not in SCALES or parameter.relative not in RELATIVE:
        fix = f"scale is one of {', '.join(SCALES)}; relative one of {', '.join(RELATIVE[1:])}, or left out."
        yield f"scale {parameter.scale!r}, relative {parameter.relative!r}", fix
    starts = parameter.start if isinstance(parameter.start, tuple) else ()
    values = [parameter.lower, parameter.upper, *starts]
    if not all(isinstance(value, (int, float)) for value in (*values, parameter.neutral)):
        yield "a bound or a start that is no number", "Give lower, upper, neutral, and a tuple of starts."
    if len(starts) > MAX_STARTS:
        yield f"{len(starts)} starts", f"Give {MAX_STARTS} at most: each is a fit."
    if not np.isfinite(values).all() or not parameter.lower < parameter.upper or not starts:
        fix = "Give finite bounds, the lower one first, and at least one start."
        yield f"bounds {parameter.lower} to {parameter.upper}, starts {parameter.start}", fix
    if not all(parameter.lower <= value <= parameter.upper for value in starts):
        yield (
            f"a start of {parameter.start} is not within {parameter.lower} and {parameter.upper}",
            "Start within them.",
        )
    if parameter.scale == "log" and not parameter.lower > 0:
        yield "a logarithmic scale from 0 or below", "Give a lower bound above 0."


def _is_tuple_of(values: object, kind: type) -> bool:
    return isinstance(values, tuple) and all(isinstance(value, kind) for value in values)


def _repeated(names: list[str]) -> list[str]:
    return [name for name in names if names.count(name) > 1]


def _try_out(form: Form, where: str, path: Path | None) -> None:
    """Apply a form once, at its first starting values, to a short made-up record."""
    turn = np.arange(ROWS) / 40.0
    width_us = np.where(np.arange(ROWS) // 8 % 2, 200.0, 0.0)
    scene = Scene(turn, width_us, 0.025, 8.0, 200.0, np.sin(turn), np.cos(turn), fitted=np.ones(ROWS, bool))
    x = {"pulse_width": width_us, "additive": None, "delay": None}.get(form.stage, 8.0 * np.abs(np.sin(turn)))
    values = {p.name: np.full((1, 1), p.on(scene).start[0]) for p in form.parameters}
    try:
        result = np.asarray(form.call(x if x is None else x[None, :], values, scene), float)
    except Exception as error:
        place = where if path is None else f"{_place(path, error)}, form {form.name!r}"
        raise BadEffect(f"apply fails: {in_one_line(error)}", place=place, fix=FIX) from error
    if result.shape not in ((1, ROWS), (1, 1)):
        message = f"apply gives {result.size} numbers, not one for each of {ROWS} pulses"
        raise BadEffect(message, place=where, fix=FIX)
    if not np.isfinite(result).all():
        raise BadEffect("apply gives numbers that are none", place=where, fix="Check it at the starting values.")
