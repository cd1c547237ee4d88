"""The languages of the pages: one gettext catalogue for each, English in the source.

What is stored and what `/v1` answers is English. A text is translated when a page shows it: the texts of the pages by
`_`, sentences that other parts made (`identify`, the rig, problems) by `translated`. Here stands in which language the
page under way is written, English where nobody set it; its texts, its numbers and times.

Each file `<code>.po` in this folder is a language of the pages; nothing else names it. Units stay SI.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from babel import Locale, negotiate_locale
from babel.dates import format_date
from babel.messages.catalog import Catalog
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po
from babel.support import LazyProxy, Translations

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


def first(message: str | list[str] | tuple[str, ...]) -> str:
    """A message as it stands, or its form for one."""
    return message if isinstance(message, str) else message[0]


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
            wanted.append((-float(weight or 1.0), place, tag.strip().lower()))
        except ValueError:
            continue
    preferred = [tag for weight, _, tag in sorted(wanted) if weight < 0]
    return negotiate_locale(preferred, CODES, sep="-") or DEFAULT


# ---- texts ----------------------------------------------------------------------------------------------------------

_code: ContextVar[str] = ContextVar("language", default=DEFAULT)


def code() -> str:
    """The language's code, like ``de``."""
    return _code.get()


def locale() -> Locale:
    """How the language writes numbers and the names of months."""
    return _locale(code())


_locale = cache(Locale.parse)


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


# ---- numbers and times -----------------------------------------------------------------------------------------------

_POINT = re.compile(r"(?<=\d)\.(?=\d)")


def decimal() -> str:
    """The decimal sign."""
    return _decimal(code())


@cache
def _decimal(code: str) -> str:
    return str(_locale(code).number_symbols["latn"]["decimal"])


def localised(text: str) -> str:
    """A text with the decimal points of its numbers as the language writes them; times and versions are not numbers."""
    return text if decimal() == "." else _POINT.sub(decimal(), text)


def _local(label: str) -> datetime:
    return datetime.fromisoformat(label.replace("Z", "+00:00")).astimezone()


def day(label: str | None, year: bool = True) -> str:
    """A UTC label as a day, where this machine stands: 12 Nov 2026."""
    if not label:
        return "–"
    pattern = "dd MMM yyyy" if year else "d MMM"
    return format_date(_local(label).date(), pattern, locale=locale())


def when(label: str | None) -> str:
    """A UTC label in the machine's local time, to the minute."""
    return f"{day(label)}, {_local(label):%H:%M}" if label else "–"


def until(label: str | None) -> str:
    """As `when`, of an end: midnight is shown as the last minute of the day that it ends."""
    if label and (end := _local(label)).strftime("%H:%M") == "00:00":
        label = (end - timedelta(minutes=1)).isoformat()
    return when(label)


def clock(label: str | None) -> str:
    """A UTC label as the time of day where this machine stands, to the second."""
    return f"{_local(label):%H:%M:%S}" if label else "–"


def zone(label: str) -> str:
    """The zone that `when` writes in at that time: UTC+1."""
    offset = _local(label).utcoffset() or timedelta(0)
    minutes = round(offset.total_seconds() / 60)
    sign, (hours, rest) = "+" if minutes >= 0 else "−", divmod(abs(minutes), 60)
    return "UTC" if not minutes else f"UTC{sign}{hours}" + (f":{rest:02d}" if rest else "")


from stimrig.api.language.translated import plain as plain  # noqa: E402  it needs what stands above
from stimrig.api.language.translated import translated as translated  # noqa: E402
