"""Texts of the pages in the language of the page."""

from __future__ import annotations

from typing import Any

from babel.support import LazyProxy

from api.language.catalogues import translations
from api.language.current import code


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
