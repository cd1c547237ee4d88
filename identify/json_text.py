"""Values as JSON can hold them, and strict reading of JSON from outside: limited depth, no duplicate keys."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from typing import Any

import numpy as np


def json_value(value: Any) -> Any:
    """Arrays as lists, numpy numbers as numbers, and numbers that are not finite as None."""
    if isinstance(value, np.ndarray | np.generic):
        return json_value(value.tolist())
    if isinstance(value, dict):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


DEEPEST = 32
TOKEN = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)|[\[{]|[\]}]', re.DOTALL)
"""A whole string (to the end of the text if it is not closed), or a bracket. Each character is read once."""


class BadJson(ValueError):
    """Not JSON, or JSON that is not accepted; the message says what and where."""


class NotJson(BadJson):
    """Text that is incomplete, or is not JSON at all."""


def parse(text: str | bytes, *, deepest: int = DEEPEST, finite: bool = True) -> Any:
    """Parse a JSON text.

    `text`: bytes are UTF-8; `deepest`: largest number of brackets within one another; `finite`: whether NaN, Infinity
    and numbers too large for a float are refused. Raises BadJson: with the line, where it is known.
    """
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise BadJson(f"not UTF-8 text (byte {error.start})") from error
    _check_depth(text, deepest)
    more: dict[str, Any] = {"parse_constant": _refused, "parse_float": _finite} if finite else {}
    try:
        return json.loads(text, object_pairs_hook=_single, **more)
    except json.JSONDecodeError as error:
        raise NotJson(f"not JSON (line {error.lineno}, column {error.colno}: {error.msg})") from error
    except BadJson:
        raise
    except ValueError as error:  # an integer with thousands of digits
        raise BadJson("a number with too many digits") from error


def _check_depth(text: str, deepest: int) -> None:
    depth = 0
    for token in TOKEN.finditer(text):
        sign = text[token.start()]
        depth += (sign in "[{") - (sign in "]}")
        if depth > deepest:
            line = text.count("\n", 0, token.start()) + 1
            raise BadJson(f"more than {deepest} brackets within one another (line {line})")


def _single(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    unique = dict(pairs)
    if len(unique) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise BadJson(f"the key {twice[:60]!r} is there twice")
    return unique


def _refused(name: str) -> Any:
    raise BadJson(f"{name} is not a number")


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise BadJson(f"{digits[:40]} is too large for a number")
    return value
