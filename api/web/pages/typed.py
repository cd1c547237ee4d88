"""Numbers that people type: the one place where they are read.

Comma and point both mean the decimal sign, as both are what a person means by them. Whatever could mean two things is
refused: separators of thousands, three digits behind the sign (1,234 is a thousand to some), powers of ten, signs,
units, digits of other scripts.
"""

from __future__ import annotations

import re
from decimal import Decimal

PLAIN = re.compile(r"(0|[1-9][0-9]{0,4})(?:[.,]([0-9]{1,2}))?")


def number(text: str) -> float:
    """What a person means by what was typed.

    Raises
    ------
    ValueError
        One line for people, with what was typed.
    """
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


def shown(value: float) -> str:
    """A number as it stands in a field: exactly, and as a person would type it."""
    text = format(Decimal(repr(float(value))), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text
