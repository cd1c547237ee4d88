"""What a MODEL.json may contain, field by field. It is checked before anything is computed from it.

A check is a function of a value and its place; it raises `BadModel` with the place, or returns nothing. Fields that
are not listed here are not checked, since a later version may write more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

from stimrig.identify.errors import BadModel

Check = Callable[[Any, str], None]
FIX = "Fit the record again."
MOST_KNOTS = 1000
LONGEST = 10_000


def number(lo: float, hi: float, fix: str = FIX) -> Check:
    """A number within bounds; not a boolean."""

    def check(value: Any, place: str) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or not (lo <= value <= hi):
            raise BadModel(f"{_short(value)} is not a number from {lo:g} to {hi:g}", place=place, fix=fix)

    return check


def text(value: Any, place: str) -> None:
    """A text, not too long."""
    if not isinstance(value, str) or len(value) > LONGEST:
        raise BadModel(f"{_short(value)} is not a text, or too long", place=place, fix=FIX)


def one_of(*known: Any) -> Check:
    """One of some values; not a boolean."""

    def check(value: Any, place: str) -> None:
        if isinstance(value, bool | list | dict) or value not in known:
            listed = " or ".join("null" if one is None else str(one) for one in known)
            raise BadModel(f"{_short(value)} is not {listed}", place=place, fix=FIX)

    return check


def anything(value: Any, place: str) -> None:
    """Any value."""


def maybe(inner: Check) -> Check:
    """The inner check, or null."""

    def check(value: Any, place: str) -> None:
        if value is not None:
            inner(value, place)

    return check


def several(inner: Check, least: int = 0, most: int = LONGEST, rising: bool = False) -> Check:
    """A list whose values all pass the inner check."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, list) or not (least <= len(value) <= most):
            what = f"a list of {len(value)}" if isinstance(value, list) else _short(value)
            raise BadModel(f"{what}, not a list of {least} to {most}", place=place, fix=FIX)
        for index, item in enumerate(value):
            inner(item, f"{place}.{index}")
        if rising and any(not (b > a) for a, b in pairwise(value)):
            raise BadModel("the values are not strictly rising", place=place, fix=FIX)

    return check


def each(inner: Check) -> Check:
    """An object whose values all pass the inner check."""

    def check(value: Any, place: str) -> None:
        for name, item in _object(value, place).items():
            inner(item, f"{place}.{name}"[:100])

    return check


def fields(wanted: Mapping[str, Check], optional: Mapping[str, Check] | None = None) -> Check:
    """An object with these fields; it may have more."""

    def check(value: Any, place: str) -> None:
        prefix = f"{place}." if place else ""
        found = _object(value, place)
        for name, inner in wanted.items():
            if name not in found:
                raise BadModel("the key is missing", place=prefix + name, fix=FIX)
            inner(found[name], prefix + name)
        for name, inner in (optional or {}).items():
            if name in found:
                inner(found[name], prefix + name)

    return check


def kinds(known: Mapping[str, Check], default: str = "") -> Check:
    """An object whose `kind` selects the check of its other fields."""

    def check(value: Any, place: str) -> None:
        kind = _object(value, place).get("kind", default)
        if not isinstance(kind, str) or kind not in known:
            message = f"unknown {place.rpartition('.')[2]} {_short(kind)}"
            raise BadModel(message, place=f"{place}.kind", fix=f"Known: {', '.join(known)}.")
        known[kind](value, place)

    return check


def _object(value: Any, place: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise BadModel(f"{_short(value)} is not a JSON object", place=place, fix=FIX)
    return value


def _short(value: Any) -> str:
    shown = repr(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
    return shown if len(shown) <= 40 else f"{shown[:40]}…"


ANY = number(-1e300, 1e300)
WIDTH = number(0.0, 1e6)
STATISTIC = maybe(ANY)
NOT_NEGATIVE = number(0.0, 1e300)
STATISTICS = (
    "fit_percent", "ceiling_percent", "rms_nm", "noise_sd_nm", "held_out_fit_percent", "held_out_ceiling_percent",
    "held_out_rms_nm",
)  # fmt: skip

COEFFICIENTS = several(ANY, 1, 2 * MOST_KNOTS)
BASIS = kinds(
    {
        "cubic-spline": fields(
            {"knots_us": several(WIDTH, 2, MOST_KNOTS, rising=True), "coefficients_nm": COEFFICIENTS}
        ),
        "power-series": fields(
            {"order": number(1, 20), "scale_us": number(1e-3, 1e6), "coefficients_nm": COEFFICIENTS}
        ),
        "sigmoid": fields(
            {"a2_per_us": ANY, "a3": ANY, "coefficients_nm": COEFFICIENTS},
            {"largest_us": number(1e-3, 1e6)},
        ),
    }
)
LINEAR = kinds(
    {
        "second-order": fields(
            {"time_constant_s": number(1e-6, 1e4), "damping": number(1e-6, 1e4)}, {"delay_s": number(-10, 10)}
        ),
        "discrete": fields(
            {
                "b": several(ANY, 1, 1000), "a": several(ANY, 1, 1000), "delay_samples": number(0, 10_000),
                "step_s": number(1e-4, 10),
            },
            {"centre": number(-10, 10)},
        ),
    },
    "discrete",
)  # fmt: skip
PLAUSIBLE = 1e6
"""Larger than any torque, N·m, or time, s, in a record."""


def pair(value: Any, place: str) -> None:
    """A number or null, or two of them."""
    try:
        STATISTIC(value, place)
    except BadModel:
        several(STATISTIC, 2, 2)(value, place)


def parameter_value(value: Any) -> Any:
    """The number of a parameter, which is given alone or as {"value", "sd", "unit"}."""
    return value["value"] if isinstance(value, dict) and "value" in value else value


SETTINGS = {
    "scale_nm": number(1e-9, PLAUSIBLE),
    "noise_sd_nm": number(0.0, PLAUSIBLE),
    "zero_nm": number(-PLAUSIBLE, PLAUSIBLE),
    "sign": one_of(1, -1),
    "reference_s": number(-PLAUSIBLE, PLAUSIBLE),
}
JOINT_SETTINGS = {
    "reference_rad": number(-1e3, 1e3),
    "angle_range_rad": several(number(-1e3, 1e3), 2, 2, rising=True),
    "angle_late_s": number(-1.0, 1.0),
}
"""Of a record with an angle."""
EFFECT_STATE = number(0.0, 1.0, "Give a number from 0 (rested) to 1, or leave it out: rested.")
_LINE = several(ANY, 0, 1000)
_SHAPE = fields(
    {
        **dict.fromkeys(("enters", "driven_by", "words", "driver", "effect"), text),
        "at": _LINE,
        "lines": each(fields(dict.fromkeys(("value", "lower", "upper"), _LINE))),
    }
)
_EFFECT = fields(
    {"id": text, "parameters": each(lambda value, place: ANY(parameter_value(value), place))},
    {
        "form": text,
        "settings": fields({}, SETTINGS | JOINT_SETTINGS),
        "state": EFFECT_STATE,
        "unforeseen": fields({"mean_nm": number(-PLAUSIBLE, PLAUSIBLE), "rms_nm": number(0.0, PLAUSIBLE)}),
        "shape": _SHAPE,
    },
)


def effect(value: Any, place: str) -> None:
    """An effect; of a free one every parameter has its sd, and every line of the picture a value at each place."""
    _EFFECT(value, place)
    if "shape" not in value:
        return
    each(fields({"value": ANY, "sd": maybe(ANY)}))(value["parameters"], f"{place}.parameters")
    count = len(value["shape"]["at"])
    for name, line in value["shape"]["lines"].items():
        for key, numbers in line.items():
            several(ANY, count, count)(numbers, f"{place}.shape.lines.{name}.{key}"[:100])


WHOLE = number(0, LONGEST)
_NARX = fields(
    {
        "variables": several(several(WHOLE, 2, 2), 1, 1000), "terms": several(several(WHOLE, 0, 20), 0, 1000),
        "weights": several(ANY, 0, 1000), "torque_scale_nm": ANY, "width_scale_us": ANY, "baseline_nm": ANY,
    }
)  # fmt: skip


def narx(value: Any, place: str) -> None:
    """A NARX polynomial: one weight per term, and terms that use existing variables."""
    _NARX(value, place)
    if len(value["terms"]) != len(value["weights"]):
        raise BadModel("terms and weights differ in number", place=place, fix=FIX)
    largest = max((index for term in value["terms"] for index in term), default=-1)
    if not (largest < len(value["variables"])):
        raise BadModel(f"a term uses variable {largest}, which does not exist", place=f"{place}.terms", fix=FIX)


COVARIANCE = fields(
    {
        "names": several(text),
        "values": several(maybe(ANY)),
        "matrix": several(several(maybe(ANY), most=1000), most=1000),
    }
)
ANGLES = several(number(-1e3, 1e3), 1, 1000, rising=True)
TABLE = several(several(ANY, 1, 1000), 1, 1000)
_JOINT = fields(
    {
        "reference_angle_rad": number(-1e3, 1e3), "angle_rad": ANGLES, "velocity_rad_s": ANGLES, "g": TABLE,
        "h_nm": TABLE, "inertia_nm_s2_per_rad": ANY,
    },
    dict.fromkeys(("g_lower", "g_upper", "h_lower_nm", "h_upper_nm", "seen_g", "seen_h"), TABLE),
)  # fmt: skip


def joint(value: Any, place: str) -> None:
    """Tables with one row for each angle and one column for each velocity."""
    if value == {}:
        return
    _JOINT(value, place)
    rows, columns = len(value["angle_rad"]), len(value["velocity_rad_s"])
    for name in ("g", "h_nm", "g_lower", "g_upper", "h_lower_nm", "h_upper_nm", "seen_g", "seen_h"):
        table = value.get(name)
        if table is not None and (len(table) != rows or any(len(row) != columns for row in table)):
            raise BadModel(f"not {rows} rows of {columns}", place=f"{place}.{name}", fix=FIX)


REPETITION = fields(
    {"found_by": one_of(None, "exact repeats", "estimate"), "explained_percent": maybe(number(0.0, 100.0))}
    | dict.fromkeys(
        ("repeats", "seconds", "rms_nm", "model_rms_nm", "held_out_rms_nm", "held_out_model_rms_nm"),
        maybe(NOT_NEGATIVE),
    )
)
NOISE = {
    "white_sd_nm": maybe(NOT_NEGATIVE), "block_sd_nm": maybe(NOT_NEGATIVE), "ar1": maybe(number(-1.0, 1.0)),
    "delta_bic": STATISTIC,
}  # fmt: skip
FIT = dict.fromkeys(STATISTICS, STATISTIC) | {
    "unexplained_nm": NOT_NEGATIVE, "unforeseen_nm": NOT_NEGATIVE, "repetition": maybe(REPETITION),
}  # fmt: skip
MODEL = fields(
    {
        "method": text,
        "recruitment": fields({"basis": BASIS}),
        "linear": LINEAR,
        "pulse_rate_hz": number(1, 200),
        "sample_rate_hz": number(0.1, 1e5),
    },
    {
        "record_rate_hz": number(0.1, 1e5),
        "baseline_nm": ANY,
        "initial": several(ANY, 2, 2),
        "noise": fields({}, NOISE),
        "effects": several(effect, most=50),
        "joint": joint,
        "uncertainty": maybe(fields({}, {"covariance": maybe(COVARIANCE), "bands": each(anything)})),
        "fit": fields({}, FIT),
        "residual_tests": each(each(anything)),
        "valid_for": each(pair),
        "quality": fields(
            {},
            {
                "verdict": text,
                "words": text,
                "reasons": several(text),
                "gates": each(fields({"passed": anything, "says": text})),
            },
        ),
        "reasons": several(text),
        "data": each(anything),
        "software": each(anything),
        "extra": fields({}, {"narx": narx, "parts": several(several(ANY, 3, 3), 1, 1000)}),
        "model_id": text,
        "created": text,
    },
)
"""Check of the whole document."""
