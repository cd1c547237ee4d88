"""Names of people as they sign in: with spaces and umlauts, one way to write each, and no two that look the same."""

from __future__ import annotations

import unicodedata

LONGEST = 80
MARKS = " ._@'’,()-"
"""What a name may hold beside letters, their marks and digits."""
UNSEEN = frozenset("\u034f\u115f\u1160\u17b4\u17b5\u3164\uffa0")
"""Letters and marks that nobody sees; Unicode calls them ignorable."""
ALPHABETS = frozenset({"LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE"})
"""Alphabets that share letters of one shape: a name keeps to one of them."""


def written(text: str) -> str:
    """A name in the one way that it is stored: composed (NFC), every run of white space one space, none at the ends.

    Raises
    ------
    ValueError
        In a sentence for people: what the name holds that it cannot, or how long it is.
    """
    composed = unicodedata.normalize("NFC", text).strip()
    spaced = "".join(" " if unicodedata.category(sign) == "Zs" else sign for sign in composed)
    name = " ".join(part for part in spaced.split(" ") if part)
    if not 1 <= len(name) <= LONGEST:
        raise ValueError(f"a name has 1 to {LONGEST} characters, this one {len(name)}")
    odd = next((sign for sign in name if not _allowed(sign)), None)
    if odd is not None:
        raise ValueError(f"the character {_called(odd)} cannot stand in a name")
    if not any(unicodedata.category(sign)[0] in "LN" for sign in name):
        raise ValueError("a name has at least one letter or digit")
    found = {unicodedata.name(sign, "").split(" ")[0] for sign in name} & ALPHABETS
    if len(found) > 1:
        raise ValueError(f"letters of two alphabets ({', '.join(sorted(found)).lower()}) look alike; take one of them")
    return name


def folded(text: str) -> str:
    """A name as two people must not share it: without its case and without the ways to write its letters."""
    plain = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    return " ".join(plain.split())


def _allowed(sign: str) -> bool:
    kind = unicodedata.category(sign)
    letter = kind[0] == "L" or kind in ("Mn", "Mc", "Nd")
    selector = "VARIATION SELECTOR" in unicodedata.name(sign, "")
    return (letter and sign not in UNSEEN and not selector) or sign in MARKS


def _called(sign: str) -> str:
    """A character so that a person can find it, also where it is not seen."""
    return f"U+{ord(sign):04X} ({unicodedata.name(sign, 'without a name').lower()})"
