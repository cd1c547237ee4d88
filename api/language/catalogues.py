"""The catalogues: each file `<code>.po` in this folder is a language of the pages; nothing else names it."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path

from babel import Locale, UnknownLocaleError
from babel.messages.catalog import Catalog
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po
from babel.support import Translations

HERE = Path(__file__).parent
DEFAULT = "en"
"""The language of the source."""
CODES = (DEFAULT, *sorted(path.stem for path in HERE.glob("*.po")))
"""The languages that there are."""


def names() -> dict[str, str]:
    """Each language's own name, by its code."""
    return {code: (Locale.parse(code).get_language_name(code) or code).capitalize() for code in CODES}


@cache
def catalogue(code: str) -> Catalog:
    """The messages of a language; none for English."""
    if code == DEFAULT:
        return Catalog(locale=code)
    with (HERE / f"{code}.po").open("rb") as file:
        return read_po(file, locale=code)


@cache
def translations(code: str) -> Translations:
    """The catalogue as gettext uses it."""
    compiled = io.BytesIO()
    write_mo(compiled, catalogue(code))
    compiled.seek(0)
    return Translations(compiled)


def best(accepted: str) -> str:
    """The language for an `Accept-Language` header (RFC 9110, 12.5.4): the one with most weight that we have."""
    wanted = []
    for place, part in enumerate(accepted[:400].split(",")):
        tag, _, weight = part.partition(";q=")
        try:
            wanted.append((-float(weight or 1.0), place, tag.strip()))
        except ValueError:
            continue
    for weight, _, tag in sorted(wanted):
        try:
            code = Locale.parse(tag, sep="-").language if weight < 0 else ""
        except (ValueError, UnknownLocaleError, TypeError):
            continue
        if code in CODES:
            return code
    return DEFAULT
