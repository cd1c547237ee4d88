"""A user's own effect from its file: loaded and tried at once, so that an error names its file and line."""

from __future__ import annotations

import importlib.util
import re
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw
from stimrig.identify.dynamics.variable_speed import Lag, SpeedLaw
from stimrig.identify.effects.base import JOINT_COLUMNS, STAGES, Effect, Form, Parameter, Scene
from stimrig.identify.errors import BadRequest, IdentifyError

FIX = "See docs/add-an-effect.md."
SCALES = ("linear", "log")
RELATIVE = ("", "torque", "width", "span", "level")
REACH = 4.0
"""Standard deviations by which a parameter of a written file may move from what was found."""
ID = r"[a-z][a-z0-9_]{0,63}"
HEAD = "from stimrig.effects import Effect, Form, Parameter"
ROWS = 80
"""Pulse intervals on which a form is tried."""


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
    if not isinstance(effect, Effect):
        message = f"EFFECT is a {type(effect).__name__}, not an Effect"
        raise BadEffect(message, place=place, fix="Give EFFECT = Effect(...).")
    if not isinstance(effect.id, str) or not re.fullmatch(ID, effect.id):
        raise BadEffect(
            f"id {effect.id!r}", place=place, fix="Use small letters, digits and _, beginning with a letter."
        )
    forms = effect.forms
    if not isinstance(forms, tuple) or not forms or not all(isinstance(form, Form) for form in forms):
        fix = "Give forms=(Form(...),), with a comma before the closing bracket."
        raise BadEffect("forms is no tuple of Form", place=place, fix=fix)
    if not isinstance(effect.needs, tuple) or not JOINT_COLUMNS.issuperset(effect.needs):
        fix = f"Give a tuple of {' and '.join(sorted(JOINT_COLUMNS))}, or leave it out."
        raise BadEffect(f"needs {effect.needs!r}", place=place, fix=fix)
    if not _is_number(effect.prior):
        raise BadEffect(f"prior {effect.prior!r}", place=place, fix="Give a finite number.")
    names = [form.name for form in forms]
    if twice := [name for name in names if names.count(name) > 1]:
        raise BadEffect(f"two forms are called {twice[0]!r}", place=place, fix="Name each form once.")
    for form in forms:
        _check_form(form, place, path)
    return effect


def text_of(effect: Effect, form: Form, estimates: Mapping[str, tuple[float, float]], name: str) -> str:
    """A file of one's own that holds what a free effect was found to be, to be edited and named.

    `estimates`: by parameter, its value and standard deviation: where a fit starts, and how far it may go (`REACH`).
    `name`: the id of the effect in the file.

    Raises BadRequest: the name is none, or the free effect's.
    """
    if not re.fullmatch(ID, name) or name == effect.id:
        fix = "Use small letters, digits and _, beginning with a letter, and another name than the free effect's."
        raise BadRequest(f"no name for an effect: {name!r}", place="name", fix=fix)
    if not np.isfinite([*estimates.values()]).all():
        raise BadRequest("a value that is no number", place=effect.id, fix="Fit the record again.")
    rows = "".join(f"                {_row(parameter, *estimates[parameter.name])},\n" for parameter in form.parameters)
    law = ", ".join(f'"{key}": FreeLaw.{FreeLaw(value).name}' for key, value in form.law.items())  # type: ignore
    fixed_laws = ", ".join(f"FreeLaw.{key.name}: {value}" for key, value in form.held.items())
    more = [f"law={{{law}}}"] * bool(law) + [f"held={{{fixed_laws}}}"] * bool(fixed_laws)
    lines = ["from stimrig.effects import Effect, Form, FreeLaw, Parameter" if law else HEAD]
    if form.apply is not None:
        lines.append(f"from stimrig.identify.effects.{effect.id} import {form.name}")
        more = [f"apply={form.name}.apply", "batched=True"]
    ends = "".join(f"            {argument},\n" for argument in more)
    return (
        f'"""What {effect.id} was found to be: edit it, name it, and let it be fitted (docs/add-an-effect.md)."""\n\n'
        + "\n".join(lines)
        + f'\n\nEFFECT = Effect(\n    id="{name}",\n    name={name.replace("_", " ").capitalize()!r},\n    forms=(\n'
        f"        Form(\n            {form.name!r},\n            {form.stage!r},\n            {form.equation!r},\n"
        f"            (\n{rows}            ),\n{ends}        ),\n    ),\n    signature={effect.signature!r},\n"
        f"    resembles=({effect.id!r},),\n    separated_by={effect.separated_by!r},\n"
        f'    plain="Say here what it is.",\n    source="Say here where it is described.",\n)\n'
    )


def _row(parameter: Parameter, value: float, sd: float) -> str:
    """A parameter that starts at what was found, as Python writes it."""
    reach = max(REACH * sd, 0.1 * abs(value), 0.02 * (parameter.upper - parameter.lower))
    lower, upper = max(parameter.lower, value - reach), min(parameter.upper, value + reach)
    numbers = [f"{number:.6g}" for number in (lower, upper, parameter.neutral, value)]
    numbers[3] = f"({min(max(float(numbers[3]), float(numbers[0])), float(numbers[1])):.6g},)"
    return (
        f"Parameter({parameter.name!r}, {parameter.unit!r}, {', '.join(numbers)}, {parameter.scale!r}, "
        f"about={parameter.about!r})"
    )


def _check_form(form: Form, place: str, path: Path | None) -> None:
    where = f"{place}, form {form.name!r}"
    if form.stage not in STAGES:
        raise BadEffect(f"no stage is called {form.stage!r}", place=where, fix=f"Give one of {', '.join(STAGES)}.")
    if not isinstance(form.parameters, tuple) or not all(isinstance(p, Parameter) for p in form.parameters):
        fix = "Give parameters=(Parameter(...),), with a comma before the closing bracket."
        raise BadEffect("parameters is no tuple of Parameter", place=where, fix=fix)
    names = [parameter.name for parameter in form.parameters]
    if wrong := [name for name in (form.name, *names) if not isinstance(name, str)]:
        raise BadEffect(f"a name that is {wrong[0]!r}", place=where, fix="Give a text.")
    if twice := [name for name in names if names.count(name) > 1]:
        raise BadEffect(f"two parameters are called {twice[0]!r}", place=where, fix="Name each parameter once.")
    for parameter in form.parameters:
        _check_parameter(parameter, where)
    _check_laws(form, names, where)
    if form.apply is None and not form.law:
        raise BadEffect("no apply", place=where, fix="Give apply=, a function of (x, p, scene).")
    if form.apply is not None and form.stage not in ("speed", "lags", "branch", "filter"):
        _try_out(form, where, path)


def _check_laws(form: Form, names: list[str], where: str) -> None:
    """Check `law` and `held`: with "lags" each parameter must have a `FreeLaw`; with "speed" a law is optional."""
    for what in ("law", "held"):
        mapping = getattr(form, what)
        if not isinstance(mapping, dict):
            raise BadEffect(
                f"{what} is a {type(mapping).__name__}", place=where, fix="Give a dictionary, or leave it out."
            )
    free = form.stage == "lags"
    for name, law in form.law.items():
        kinds = [*map(type, law)] if isinstance(law, tuple) else [type(law)]
        if name not in names or kinds != ([FreeLaw] if free else [Lag, SpeedLaw]):
            expected = "FreeLaw} of free_lags" if free else "(Lag, SpeedLaw)}, both of variable_speed"
            fix = f"Give law={{parameter: {expected} in stimrig.identify.dynamics."
            raise BadEffect(f"law {name!r}: {law!r}", place=where, fix=fix)
    if free and set(form.law) != set(names):
        raise BadEffect("a parameter without a law", place=where, fix="Give law={parameter: FreeLaw} for each.")
    if form.held and not (free and all(isinstance(key, FreeLaw) for key in form.held)):
        raise BadEffect(f"held {dict(form.held)!r}", place=where, fix='Give held={FreeLaw: number}, for "lags" only.')
    if free:
        _check_free(form, where)


def _check_free(form: Form, where: str) -> None:
    """Check that each law is set once and that its bounds lie in the range that the kernel accepts."""
    ranges: dict[Any, tuple[float, float]] = {
        law: (float(value), float(value)) for law, value in form.held.items() if _is_number(value)
    }
    if len(ranges) < len(form.held):
        raise BadEffect(f"held {dict(form.held)!r}", place=where, fix="Give finite numbers.")
    for parameter in form.parameters:
        law = form.law[parameter.name]
        if law in ranges:
            raise BadEffect(f"{law!r} is set twice", place=where, fix="Give each FreeLaw once, in law or in held.")
        ranges[law] = parameter.lower, parameter.upper
    idle = [law for law in OF_STATE if law in ranges and FreeLaw.FILL_S not in ranges]
    if idle:
        raise BadEffect(
            f"{idle[0]!r} without FILL_S", place=where, fix="It does nothing: give FILL_S and EMPTY_S, too."
        )
    if (FreeLaw.FILL_S in ranges) != (FreeLaw.EMPTY_S in ranges):
        raise BadEffect("FILL_S without EMPTY_S, or EMPTY_S without FILL_S", place=where, fix="Give both or none.")
    for law, bound in POSITIVE.items():
        if law in ranges and not ranges[law][0] > bound:
            raise BadEffect(f"{law!r} from {ranges[law][0]:g}", place=where, fix=f"Give values above {bound:g}.")


POSITIVE = {FreeLaw.FILL_S: 0.0, FreeLaw.EMPTY_S: 0.0, FreeLaw.GATE_S: 0.0, FreeLaw.BEND: -1.0}
"""Lower bounds of laws by which, or by one more than which, the kernel divides."""
OF_STATE = FreeLaw.GAIN, FreeLaw.RATE, FreeLaw.ZERO, FreeLaw.BY_PULSES, FreeLaw.BY_DRIVE
"""Actions of the slow state, and the signals that fill it."""
MAX_STARTS = 32
"""Each is a fit."""


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _check_parameter(parameter: Parameter, where: str) -> None:
    place = f"{where}, parameter {parameter.name!r}"
    if parameter.scale not in SCALES or parameter.relative not in RELATIVE:
        message = f"scale {parameter.scale!r}, relative {parameter.relative!r}"
        fix = f"scale is one of {', '.join(SCALES)}; relative one of {', '.join(RELATIVE[1:])}, or left out."
        raise BadEffect(message, place=place, fix=fix)
    starts = parameter.start if isinstance(parameter.start, tuple) else ()
    values = [parameter.lower, parameter.upper, *starts]
    if not all(isinstance(value, (int, float)) for value in (*values, parameter.neutral)):
        message = "a bound or a start that is no number"
        raise BadEffect(message, place=place, fix="Give lower, upper, neutral, and a tuple of starts.")
    if len(starts) > MAX_STARTS:
        raise BadEffect(f"{len(starts)} starts", place=place, fix=f"Give {MAX_STARTS} at most: each is a fit.")
    numbers = np.array(values, float)
    if not np.isfinite(numbers).all() or not parameter.lower < parameter.upper or numbers.size < 3:
        message = f"bounds {parameter.lower} to {parameter.upper}, starts {parameter.start}"
        raise BadEffect(message, place=place, fix="Give finite bounds, the lower one first, and at least one start.")
    if not ((numbers[2:] >= parameter.lower) & (numbers[2:] <= parameter.upper)).all():
        message = f"a start of {parameter.start} is not within {parameter.lower} and {parameter.upper}"
        raise BadEffect(message, place=place, fix="Start within the bounds.")
    if parameter.scale == "log" and not parameter.lower > 0:
        raise BadEffect("a logarithmic scale from 0 or below", place=place, fix="Give a lower bound above 0.")


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
