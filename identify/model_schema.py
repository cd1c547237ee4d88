"""Checks of a MODEL.json against model.schema.json, the published JSON Schema, by the few rules that it uses.

It is checked before anything is computed from it. Keys that the schema does not know are not checked, since a later
version may write more. Keys that it requires may be missing, except those of `x-needed`.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Any

from stimrig.identify.errors import BadModel

FILE = Path(__file__).parent / "model.schema.json"
SCHEMA: dict[str, Any] = json.loads(FILE.read_text("utf-8"))
STATE: dict[str, Any] = SCHEMA["properties"]["effects"]["items"]["properties"]["state"]
FIX = "Fit the record again."
LONGEST = 10_000
"""Largest length of a list or a text without a limit in the schema."""
LARGEST = 1e300
"""Largest number without a limit in the schema."""
PLAUSIBLE = 1e6
"""Larger than any torque, N·m, or time, s, in a record."""
PYTHON: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "number": int | float, "integer": int | float,
    "null": NoneType,
}  # fmt: skip
NUMBERS = {"type": "object", "additionalProperties": {"type": "number"}}
WITH_SD = {"type": "object", "additionalProperties": {"type": "object", "x-needed": ["value", "sd"]}}
TABLES = ("g", "h_nm", "g_lower", "g_upper", "h_lower_nm", "h_upper_nm", "seen_g", "seen_h")


def check_model(document: dict[str, Any]) -> None:
    """Raises BadModel: the document, or what its parts have to do with one another, is not as in a MODEL.json."""
    check(document, SCHEMA, "")
    for index, effect in enumerate(document.get("effects", ())):
        place, parameters = f"effects.{index}", effect["parameters"]
        values = {name: parameter_value(value) for name, value in parameters.items()}
        check(values, NUMBERS, f"{place}.parameters")
        if "shape" in effect:  # a free effect has an sd for each parameter, and a value of each line at each place
            check(parameters, WITH_SD, f"{place}.parameters")
            count = len(effect["shape"]["at"])
            as_many = {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count}
            for name, line in effect["shape"]["lines"].items():
                line_place = f"{place}.shape.lines.{name}"[:100]
                check(line, {"type": "object", "additionalProperties": as_many}, line_place)
    if "joint" in document:
        joint = document["joint"]
        rows, columns = len(joint["angle_rad"]), len(joint["velocity_rad_s"])
        for name in TABLES:
            table = joint.get(name)
            if table is not None and (len(table) != rows or any(len(row) != columns for row in table)):
                raise BadModel(f"not {rows} rows of {columns}", place=f"joint.{name}", fix=FIX)
    if (narx := document.get("extra", {}).get("narx")) is not None:
        if len(narx["terms"]) != len(narx["weights"]):
            raise BadModel("terms and weights differ in number", place="extra.narx", fix=FIX)
        largest = max((index for term in narx["terms"] for index in term), default=-1)
        if not (largest < len(narx["variables"])):
            raise BadModel(f"a term uses variable {largest}, which does not exist", place="extra.narx.terms", fix=FIX)
    elif document["method"] == "narx":
        raise BadModel("the key is missing", place="extra.narx", fix=FIX)


def parameter_value(value: Any) -> Any:
    """The number of a parameter, which is given alone or as {"value", "sd", "unit"}."""
    return value["value"] if isinstance(value, dict) and "value" in value else value


def check(value: Any, schema: dict[str, Any], place: str) -> None:
    """Raises BadModel with the place: the value is not what the schema says."""
    if "$ref" in schema:
        schema = SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]] | schema
    named, also = schema.get("type", []), schema.get("x-also", ())
    kinds = [*([named] if isinstance(named, str) else named), *also]
    kind = next((kind for kind in kinds if isinstance(value, PYTHON[kind])), kinds[0] if kinds else "")
    known = schema.get("enum", [schema["const"]] if "const" in schema else None)
    wrong = ""
    if known is not None and kind not in also and (isinstance(value, bool | list | dict) or value not in known):
        wrong = f"is not {' or '.join('null' if choice is None else str(choice) for choice in known)}"
    elif kind in ("number", "integer"):
        lo, hi = schema.get("minimum", -LARGEST), schema.get("maximum", LARGEST)
        if isinstance(value, bool) or not isinstance(value, int | float) or not (lo <= value <= hi):
            wrong = f"is not a number from {lo:g} to {hi:g}"
        elif kind == "integer" and value != int(value):
            wrong = "is not a whole number"
    elif kind == "string" and (not isinstance(value, str) or len(value) > LONGEST):
        wrong = "is not a text, or too long"
    elif kind == "boolean" and not isinstance(value, bool):
        wrong = "is not true or false"
    elif kind == "object" and not isinstance(value, dict):
        wrong = "is not a JSON object"
    elif kind == "array":
        min_items, max_items = schema.get("minItems", 0), schema.get("maxItems", LONGEST)
        if not isinstance(value, list) or not (min_items <= len(value) <= max_items):
            wrong = f"is not a list of {min_items} to {max_items}"
    if wrong:
        raise BadModel(f"{_short(value)} {wrong}", place=place, fix=schema.get("x-mend", FIX))
    if kind == "array":
        _check_items(value, schema, place)
    elif kind == "object":
        _check_keys(value, schema, place)


def _check_items(value: list[Any], schema: dict[str, Any], place: str) -> None:
    items = schema["items"]
    lo, hi = items.get("minimum", -LARGEST), items.get("maximum", LARGEST)
    sound = items.get("type") == "number" and all(type(item) in (int, float) and lo <= item <= hi for item in value)
    for index, item in enumerate(() if sound else value):  # a table may have a million numbers: seen at once if sound
        check(item, items, f"{place}.{index}")
    if schema.get("x-rising") and any(not (b > a) for a, b in pairwise(value)):
        raise BadModel("the values are not strictly rising", place=place, fix=FIX)


def _check_keys(value: dict[str, Any], schema: dict[str, Any], place: str) -> None:
    prefix = f"{place}." if place else ""
    needed, known = schema.get("x-needed", ()), schema.get("properties", {})
    for name in value if "additionalProperties" in schema else [name for name in known if name in value]:
        check(value[name], known.get(name) or schema["additionalProperties"], f"{prefix}{name}"[:100])
    for name in schema["required"] if needed is True else needed:
        if name not in value:
            raise BadModel("the key is missing", place=prefix + name, fix=FIX)
    if "if" in schema:
        try:
            _check_keys(value, schema["if"], "")
            branch = "then"
        except BadModel:
            branch = "else"
        _check_keys(value, schema[branch], place)


def _short(value: Any) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = repr(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
    return text if len(text) <= 40 else f"{text[:40]}…"
