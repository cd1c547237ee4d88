"""Sentences that were made elsewhere, in English: by `identify`, by the rig, by a problem, or stored long ago.

They are not made anew. The catalogue holds their patterns (`the plateau is %(share)s lower`, from the f-strings of the
source, see `api.language.extract`); a sentence that fits one is written by its translation, with the same values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice

from markupsafe import Markup

from stimrig.api.language import DEFAULT, catalogue, code, first, localised

_PLACE = re.compile(r"%\((\w+)\)s")
_END = re.compile(r"(?<=[.!?;:,]) ")
_SIGN = re.compile(r"(?<!^)[ ,;:.]")
_AROUND = " .;:,"
_PROSE = re.compile(r"[A-Za-z]{2} [A-Za-z]{2}")
LONGEST = 2000
"""A longer text is data, not a sentence."""
MOST_TRIES = 1500
"""Parts of a text that are looked up before it counts as not translated: no text keeps the service busy."""
MOST_ENDS = 12
"""Ends of clauses within one message."""
STRONG = 12
"""Letters of a pattern from which on it is recognised although English stays at one of its places."""

PERSON = "who"
"""The place of a person's name, which may have two words and stays as it is."""
COUNT = "count"
"""The place of a number: what stands there may else take in the sentence before it."""

Names = tuple[str, ...]
"""Places that nothing separates."""


@dataclass(frozen=True)
class Pattern:
    """A message with places: how it is recognised, and what it becomes."""

    literals: tuple[str, ...]
    """Before, between and behind the places."""
    places: tuple[Names, ...]
    ends_in_place: bool
    """Its end is a place, and that of its translation another: a sign there is the sentence's."""
    key: str
    """The longest of `literals` in small letters, without spaces and signs around it."""
    becomes: str
    weight: int
    """Its letters."""

    def fit(self, text: str) -> list[str] | None:
        """What stands at its places, each as short as can be; None where it is another message.

        One way through the text: a regular expression with as many places would try all ways to divide it.
        """
        first, *between, last = self.literals
        at, end = len(first), len(text) - len(last)
        if at > end or not (text.startswith(first) and text.endswith(last)):
            return None
        if self.ends_in_place and text.endswith((".", ";", ":", ",", " ")):
            return None
        found = []
        for literal in between:
            found_at = text.find(literal, at, end)
            if found_at < 0:
                return None
            found.append(text[at:found_at])
            at = found_at + len(literal)
        return [*found, text[at:end]]


Value = Callable[[str, str, Pattern], str | None]
"""What stands at a place of a pattern, in the language; None where the pattern does not fit then."""


def translated(text: object) -> str:
    """The text in the page's language: its translation, or marked as English where there is none."""
    words = str(text)
    if code() == DEFAULT or not words.strip():
        return words
    found = words if words in _written(code()) else of(code(), words)
    return found if found is not None else Markup('<span lang="en">{}</span>').format(words)


def plain(text: object) -> str:
    """As `translated`, for a place within another text: without the mark where there is no translation."""
    words = translated(text)
    return str(text) if isinstance(words, Markup) else words


def of(language: str, text: str) -> str | None:
    """The translation, sentence by sentence where it is not one message; None where a part of it has none."""
    if len(text) > LONGEST:
        return None
    _tries.set(iter(range(MOST_TRIES)))
    try:
        if (found := _certain(language, text)) is not None:
            return found
        parts = re.split(r"(?<=[.!?]) ", text)
        likely = [_certain(language, part) or _message(language, part, _likely) for part in parts]
    except (_TooManyTries, RecursionError):
        return None
    return None if None in likely else " ".join(map(str, likely))


class _TooManyTries(Exception):
    """The text has too many parts that might be messages."""


_tries: ContextVar[Iterator[int]] = ContextVar("tries")


@lru_cache(maxsize=8192)
def _certain(language: str, text: str) -> str | None:
    """The translation of a message, or of messages one after the other; None where English would stay."""
    if not text:
        return ""
    whole = _message(language, text, _known)
    if whole is not None:
        return whole
    for sign in reversed(list(islice(_END.finditer(text), MOST_ENDS))):
        first = _message(language, text[: sign.start()], _known)
        if first is None and text[sign.start() - 1] == ":" and not _PROSE.search(text[: sign.start()]):
            first = text[: sign.start()]  # a name
        rest = _certain(language, text[sign.end() :]) if first is not None else None
        if rest is not None:
            return f"{first} {rest}"
    return None


@lru_cache(maxsize=8192)
def _message(language: str, text: str, value: Value) -> str | None:
    """One message: as it stands, or with another beginning or end than in the source."""
    if next(_tries.get(), None) is None:
        raise _TooManyTries
    body = text.rstrip(".;:,")
    tail = text[len(body) :]
    for given, end in ((text, ""), (body, tail)):
        for form, before, after in _forms(given):
            found = _whole(language).get(form) or _fit_pattern(language, form, value)
            if found is not None:
                found = found.removeprefix(before).removesuffix(after)
                same = given[:1].isupper() and form[:1].islower()
                return (found[:1].upper() + found[1:] if same else found) + end
    return localised(text) if not re.search(r"[A-Za-z]{3}", text) else None


def _forms(text: str) -> list[tuple[str, str, str]]:
    """How the text may stand in the source, and what it has there in addition, before and after it."""
    cases = dict.fromkeys((text, text[:1].lower() + text[1:], text[:1].upper() + text[1:]))
    return [(case, "", "") for case in cases] + [(f" {text}", " ", ""), (f"{text}.", "", "."), (f"{text} ", "", " ")]


@cache
def _whole(language: str) -> dict[str, str]:
    """What messages become as they stand, with the form for one."""
    entries = (entry for entry in catalogue(language) if entry.id and not entry.fuzzy)
    return {first(entry.id): first(entry.string) for entry in entries if entry.string and first(entry.string)}


@cache
def _written(language: str) -> frozenset[str]:
    """What translations become: a text that is in the page's language already stays."""
    return frozenset(_whole(language).values())


def _fit_pattern(language: str, text: str, value: Value) -> str | None:
    for pattern in _candidates(language, text.strip(_AROUND).lower()):
        if (fit := pattern.fit(text)) is not None:
            values = [
                _places(language, part, names, pattern, value) for part, names in zip(fit, pattern.places, strict=True)
            ]
            if None not in values:
                return pattern.becomes % {name: said for part in values if part for name, said in part.items()}
    return None


@lru_cache(maxsize=1024)
def _candidates(language: str, text: str) -> tuple[Pattern, ...]:
    """Patterns whose longest piece is in the text, whatever its case and its ends."""
    return tuple(pattern for pattern in _patterns(language) if pattern.key in text)


def _places(language: str, text: str, names: Names, pattern: Pattern, value: Value) -> dict[str, str] | None:
    """What stands at places without a word between them: the second and later ones are empty or begin with a sign."""
    if len(names) == 1:
        if names[0] == COUNT and _END.search(text):
            return None
        said = text if names[0] == PERSON else value(language, text, pattern)
        return None if said is None else {names[0]: said}
    for end in (len(text), *(sign.start() for sign in _SIGN.finditer(text))):
        said = value(language, text[:end], pattern)
        rest = _places(language, text[end:], names[1:], pattern, value) if said is not None else None
        if said is not None and rest is not None:
            return {names[0]: said, **rest}
    return None


def _known(language: str, text: str, _: Pattern) -> str | None:
    """What a place becomes: its translation, or itself where it is a name or a number; None where it is English."""
    found = _certain(language, text)
    return found if found is not None else None if _PROSE.search(text) else localised(text)


def _likely(language: str, text: str, pattern: Pattern) -> str | None:
    """As `_known`, but English (of an operating system, of a library) stays in a pattern that is surely meant."""
    found = _known(language, text, pattern)
    return localised(text) if found is None and pattern.weight >= STRONG else found


@cache
def _patterns(language: str) -> tuple[Pattern, ...]:
    """The messages with places, the most literal first."""
    entries = [(str(entry.id), str(entry.string)) for entry in catalogue(language) if isinstance(entry.id, str)]
    made = [_pattern(message, becomes) for message, becomes in entries if becomes and _PLACE.search(message)]
    return tuple(sorted((entry for entry in made if "".join(entry.literals).strip()), key=lambda entry: -entry.weight))


def _pattern(message: str, becomes: str) -> Pattern:
    pieces = _PLACE.split(message)
    given = [piece.replace("%%", "%") for piece in pieces[::2]]
    places: list[Names] = []
    literals = given[:1]
    for k, (name, literal) in enumerate(zip(pieces[1::2], given[1:], strict=True)):
        if k and not given[k]:
            places[-1] += (name,)
            literals[-1] = literal
        else:
            places.append((name,))
            literals.append(literal)
    ends_in_place = bool(places) and not given[-1] and not becomes.endswith(f"%({places[-1][-1]})s")
    weight = len(re.findall("[A-Za-z]", "".join(given)))
    key = max(given, key=len).strip(_AROUND).lower()
    return Pattern(tuple(literals), tuple(places), ends_in_place, key, becomes, weight)
