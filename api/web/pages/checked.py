"""A form's fields as a route's body takes them: the one place where a page's words meet a body's rules."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from api.errors import ApiError

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
        raise ApiError(422, "invalid-input", "This value cannot be used", detail) from None
