"""The language in which the page under way is written: set for each request, English where nobody has set it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from babel import Locale

from api.language.catalogues import CODES, DEFAULT

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
