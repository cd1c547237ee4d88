"""The languages of the pages: one gettext catalogue for each, English in the source.

What is stored and what `/v1` answers is English. A text is translated when a page shows it: the texts of the pages by
`_`, sentences that other parts made (`identify`, the rig, problems) by `translated`.
"""

from __future__ import annotations

from stimrig.api.language.translated import plain, translated
from stimrig.api.language.words import (
    CODES,
    DEFAULT,
    _,
    best,
    clock,
    code,
    day,
    decimal,
    lazy,
    locale,
    localised,
    names,
    ngettext,
    until,
    using,
    when,
    zone,
)  # fmt: skip

__all__ = [
    "CODES", "DEFAULT", "_", "best", "clock", "code", "day", "decimal", "lazy", "locale", "localised", "names",
    "ngettext", "plain", "translated", "until", "using", "when", "zone",
]  # fmt: skip
