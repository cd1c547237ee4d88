"""The language in which the page under way is written, and texts in it.

It is set for each request; English where nobody has set it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from babel import Locale
from babel.support import LazyProxy

from stimrig.api.language.catalogues import CODES, DEFAULT, translations

_code: ContextVar[str] = ContextVar("language", default=DEFAULT)


def code() -> str:
    """The language's code, like ``de``."""
    return _code.get()


def locale() -> Locale:
    """How the language writes numbers and the names of months."""
    return Locale.parse(code())


@contextmanager
def using(language: str) -> Iterator[None]:
    """Write in this language within the block; in English where it is none of ours."""
    token = _code.set(language if language in CODES else DEFAULT)
    try:
        yield
    finally:
        _code.reset(token)


def gettext(message: str) -> str:
    """The message in the page's language, its placeholders as they are; itself where it is not translated."""
    return translations(code()).ugettext(message) if message else ""  # gettext keeps the catalogue's head under ""


def plural(one: str, many: str, count: int) -> str:
    """As `gettext`, with the form for so many."""
    return translations(code()).ungettext(one, many, count)


def _(message: str, **values: Any) -> str:
    """The message in the page's language, with the values at its named places (`%(name)s`; a percent sign is `%%`)."""
    return gettext(message) % values


def ngettext(one: str, many: str, count: int, **values: Any) -> str:
    """As `_`, with the form for so many; `%(num)s` is the count."""
    return plural(one, many, count) % {"num": count, **values}


def lazy(message: str) -> Any:
    """A message of a table that is made when the program starts: translated each time that it is shown."""
    return LazyProxy(_, message, enable_cache=False)
