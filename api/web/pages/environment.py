"""The templates, and how texts, numbers and times are written in them: for pages and for reports as files."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from babel.support import LazyProxy
from jinja2 import Environment, FileSystemLoader, StrictUndefined, pass_context
from jinja2.runtime import Context

from stimrig.api import clinical_words, effect_words, language
from stimrig.api.models.changes import dose_words
from stimrig.api.models.stored_model import followed
from stimrig.rig.messages import LABEL_TITLES

HERE = Path(__file__).parent

environment = Environment(
    loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True, extensions=["jinja2.ext.i18n"],
)  # fmt: skip
environment.policies["ext.i18n.trimmed"] = True


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """A number for people, with the decimal sign of the page's language; a dash where there is none."""
    if value is None:
        return "–"
    text = language.localised(f"{value:.{digits}f}".replace("-", "−"))
    return f"{text} {unit}" if unit else text


def figures(value: float | None) -> str:
    """A number to three significant figures, without powers of ten where they can be done without."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}" if digits <= 6 else f"{value:.2g}"
    return language.localised(text.replace("-", "−"))


def in_words(value: Any) -> str:
    """A table's words in the page's language, for scripts; nothing else is written that JSON does not know."""
    if isinstance(value, LazyProxy):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no place in JSON")


texts: Any = environment  # the extension adds the method
texts.install_gettext_callables(language.gettext, language.plural, newstyle=True)


def in_its_language(words: Callable[..., Any]) -> Callable[..., Any]:
    """A filter that is asked anew for each page: of a constant jinja would keep the answer of the first page."""

    @pass_context
    @functools.wraps(words)
    def asked(_context: Context, *given: Any, **more: Any) -> Any:
        return words(*given, **more)

    return asked


environment.filters.update({name: in_its_language(words_of) for name, words_of in {
    "number": number, "followed": followed, "figures": figures, "when": language.when, "clock": language.clock,
    "day": language.day, "until": language.until,
    "translated": language.translated, "plain_words": language.plain, "localised": language.localised,
    "words": clinical_words.words, "segment_words": clinical_words.segment_words, "degrees": clinical_words.degrees,
    "effect_words": effect_words.effect_words, "effects_words": effect_words.effects_words,
    "label_rows": clinical_words.label_rows, "dose": dose_words,
}.items()})  # fmt: skip
environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "default": in_words}
environment.globals |= {"language": language, "known_words": clinical_words.WORDS, "label_titles": LABEL_TITLES}
