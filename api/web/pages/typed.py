"""What people type: the one place where numbers are read, and where a form meets the rules of a route's body.

Comma and point both mean the decimal sign, as both are what a person means by them. Whatever could mean two things is
refused: separators of thousands, three digits behind the sign (1,234 is a thousand to some), powers of ten, signs,
units, digits of other scripts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import Annotated, Any

from fastapi import Form
from pydantic import ValidationError

from stimrig.api.errors import ApiError

Text = Annotated[str, Form()]
"""A field of a form as it was typed."""
PLAIN = re.compile(r"(0|[1-9][0-9]{0,4})(?:[.,]([0-9]{1,2}))?")
NAMES = {"scopes": "role", "effects": "effect"}
"""What a field is called on the page, where that is another name."""
PATTERN = "string_pattern_mismatch"
"""Then what was typed is shown instead of the pattern, which is no word for a person."""
HINTS = {
    "code": "Take 1 to 32 letters, digits, - or _ (for example P017). "
    "Please no names: the link from a code to a person is kept elsewhere.",
    "name": "Take letters, digits, spaces, and . _ @ -.",
    "ran_by": "Type the name of the person, or leave the field empty.",
    "at_s": "Type the time from the start of the test in seconds, like 12.5.",
    "password": "Take at least 10 characters; a few words do well.",
    "days": "From 1 to 366.",
    "effect": "Go back to the model and press the button of one of its effects. Nothing was changed.",
}


def number(text: str) -> float:
    """What a person means by what was typed. Raises ValueError: one line for people, with what was typed."""
    found = PLAIN.fullmatch(text.strip())
    if found is None:
        given = f"{text.strip()[:40]!r} is not a plain number" if text.strip() else "nothing was typed"
        raise ValueError(f"{given}; type one like 9 or 9,5 or 9.5, with at most two digits behind the comma or point")
    whole, part = found.groups()
    return float(f"{whole}.{part or 0}")


def signed(text: str) -> float:
    """The same, where a minus may stand in front. Raises as `number`."""
    plain = text.strip()
    return -number(plain[1:]) if plain[:1] in ("-", "−") else number(plain)


def whole(text: str) -> int | None:
    """A whole number as it was typed; None where it is none, which whoever takes it refuses."""
    return int(text) if re.fullmatch(r"[1-9][0-9]{0,4}", text.strip()) else None


def number_text(value: float) -> str:
    """A number as it stands in a field: exactly, and as a person would type it."""
    text = format(Decimal(repr(float(value))), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def numbers(
    texts: Mapping[str, str], read: Callable[[str], float] = number
) -> tuple[dict[str, float], dict[str, str]]:  # fmt: skip
    """The numbers of a form's fields, and what is wrong, a line a field."""
    values, errors = {}, {}
    for name, text in texts.items():
        try:
            values[name] = read(text)
        except ValueError as error:
            errors[name] = str(error)
    return values, errors


def wanted(text: str, says: Callable[[str], str]) -> float:
    """A number without which nothing goes on. Raises ApiError (422): what `says` makes of what is wrong with it."""
    try:
        return number(text)
    except ValueError as error:
        raise unusable(says(str(error))) from None


def unusable(detail: str) -> ApiError:
    """422, in one line."""
    return ApiError(422, "invalid-input", "This value cannot be used", detail)


def checked(model: Any, **fields: Any) -> Any:
    """A body from a form's fields; 422 in one sentence where they do not hold, and never a password in it."""
    try:
        return model(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        field = str(first["loc"][0]) if first["loc"] else ""  # none: two fields do not go together
        field = NAMES.get(field, field)
        said = first["msg"].removeprefix("Value error, ")
        wrong = f"{str(first['input'])[:40]!r} will not do" if first["type"] == PATTERN else said
        detail = f"{field}: {wrong}. {HINTS.get(field, '')}".removeprefix(": ").strip()
        raise unusable(detail) from None
