"""A user's own effect from its file: loaded and tried at once, so that an error names its file and line."""

from __future__ import annotations

import importlib.util
import re
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.effects.base import JOINT_COLUMNS, STAGES, Effect, Form, Parameter, Scene
from stimrig.identify.errors import IdentifyError

FIX = "See docs/add-an-effect.md."
SCALES = ("linear", "log")
RELATIVE = ("", "torque", "width", "span", "level")
OWN_STAGES = tuple(stage for stage in STAGES if stage not in ("speed", "term"))
"""The laws of the two others are compiled, and those of the library alone."""
ID = r"[a-z][a-z0-9_]{0,63}"
ROWS = 80
"""Pulse intervals on which a form is tried."""
MAX_STARTS = 32
"""Each is a fit."""


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

    def refuse(wrong: bool, message: str, fix: str) -> None:
        if wrong:
            raise BadEffect(message, place=where, fix=fix)

    where = place
    refuse(
        not isinstance(effect, Effect),
        f"EFFECT is a {type(effect).__name__}, not an Effect",
        "Give EFFECT = Effect(...).",
    )
    named = isinstance(effect.id, str) and re.fullmatch(ID, effect.id)
    refuse(not named, f"id {effect.id!r}", "Use small letters, digits and _, beginning with a letter.")
    fix = "Give forms=(Form(...),), with a comma before the closing bracket."
    refuse(not effect.forms or not _is_tuple_of(effect.forms, Form), "forms is no tuple of Form", fix)
    needs_known = isinstance(effect.needs, tuple) and JOINT_COLUMNS.issuperset(effect.needs)
    fix = f"Give a tuple of {' and '.join(sorted(JOINT_COLUMNS))}, or leave it out."
    refuse(not needs_known, f"needs {effect.needs!r}", fix)
    is_finite = isinstance(effect.prior, int | float) and np.isfinite(effect.prior)
    refuse(not is_finite, f"prior {effect.prior!r}", "Give a finite number.")
    twice = _repeated([form.name for form in effect.forms])
    refuse(twice is not None, f"two forms are called {twice!r}", "Name each form once.")
    for form in effect.forms:
        where = f"{place}, form {form.name!r}"
        stages = ", ".join(OWN_STAGES)
        refuse(form.stage not in OWN_STAGES, f"no stage is called {form.stage!r}", f"Give one of {stages}.")
        fix = "Give parameters=(Parameter(...),), with a comma before the closing bracket."
        refuse(not _is_tuple_of(form.parameters, Parameter), "parameters is no tuple of Parameter", fix)
        names = [parameter.name for parameter in form.parameters]
        wrong = [name for name in (form.name, *names) if not isinstance(name, str)]
        refuse(bool(wrong), f"a name that is {wrong[:1]}", "Give a text.")
        twice = _repeated(names)
        refuse(twice is not None, f"two parameters are called {twice!r}", "Name each parameter once.")
        refuse(form.apply is None, "no apply", "Give apply=, a function of (x, p, scene).")
        for p in form.parameters:
            where = f"{place}, form {form.name!r}, parameter {p.name!r}"
            fix = f"scale is one of {', '.join(SCALES)}; relative one of {', '.join(RELATIVE[1:])}, or left out."
            unknown = p.scale not in SCALES or p.relative not in RELATIVE
            refuse(unknown, f"scale {p.scale!r}, relative {p.relative!r}", fix)
            starts = p.start if isinstance(p.start, tuple) else ()
            values = [p.lower, p.upper, *starts]
            numbers = all(isinstance(value, int | float) for value in (*values, p.neutral))
            fix = "Give lower, upper, neutral, and a tuple of starts."
            refuse(not numbers, "a bound or a start that is no number", fix)
            refuse(len(starts) > MAX_STARTS, f"{len(starts)} starts", f"Give {MAX_STARTS} at most: each is a fit.")
            fix = "Give finite bounds, the lower one first, and at least one start."
            bounded = np.isfinite(values).all() and p.lower < p.upper and starts
            refuse(not bounded, f"bounds {p.lower} to {p.upper}, starts {p.start}", fix)
            outside = not all(p.lower <= value <= p.upper for value in starts)
            refuse(outside, f"a start of {p.start} is not within {p.lower} and {p.upper}", "Start within them.")
            below = p.scale == "log" and not p.lower > 0
            refuse(below, "a logarithmic scale from 0 or below", "Give a lower bound above 0.")
        if form.stage not in ("branch", "filter"):
            _try_out(form, f"{place}, form {form.name!r}", path)
    return effect


def _is_tuple_of(values: object, kind: type) -> bool:
    return isinstance(values, tuple) and all(isinstance(value, kind) for value in values)


def _repeated(names: list[str]) -> str | None:
    return next((name for name in names if names.count(name) > 1), None)


def _try_out(form: Form, where: str, path: Path | None) -> None:
    """Apply a form once, at its first starting values, to a short made-up record."""
    turn = np.arange(ROWS) / 40.0
    width_us = np.where(np.arange(ROWS) // 8 % 2, 200.0, 0.0)
    scene = Scene(turn, width_us, 0.025, 8.0, 200.0, np.sin(turn), np.cos(turn), fitted=np.ones(ROWS, bool))
    x = {"pulse_width": width_us, "additive": None, "delay": None}.get(form.stage, 8.0 * np.abs(np.sin(turn)))
    values = {p.name: np.full((1, 1), p.on(scene).start[0]) for p in form.parameters}
    try:
        result = np.asarray(form.call(x if x is None else x[None, :], values, scene), float)
    except (Exception, SystemExit) as error:
        place = where if path is None else f"{_place(path, error)}, form {form.name!r}"
        raise BadEffect(f"apply fails: {in_one_line(error)}", place=place, fix=FIX) from error
    if result.shape not in ((1, ROWS), (1, 1)):
        message = f"apply gives {result.size} numbers, not one for each of {ROWS} pulses"
        raise BadEffect(message, place=where, fix=FIX)
    if not np.isfinite(result).all():
        raise BadEffect("apply gives numbers that are none", place=where, fix="Check it at the starting values.")
