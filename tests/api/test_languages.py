"""The languages of the pages: which one is taken, how numbers and dates are written, what is translated."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from babel.messages.catalog import Catalog
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api import language
from stimrig.api.language import extract, translated, words
from stimrig.api.language.words import best

PLACE = re.compile(r"%\((\w+)\)s|(?<!%)%(?![%(])|\{\w+\}")


@pytest.mark.parametrize(
    ("accepted", "code"),
    [
        ("de", "de"), ("de-AT,de;q=0.9,en;q=0.5", "de"), ("en-US,en;q=0.9,de;q=0.8", "en"), ("fr,de;q=0.2", "de"),
        ("fr", "en"), ("", "en"), ("*", "en"), ("de;q=0", "en"), ("de;q=x", "en"), ("q" * 5000, "en"),
    ],
)  # fmt: skip
def test_the_browsers_language_is_taken_where_there_is_one(
    accepted: str, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(words, "CODES", ("en", "de"))  # whatever other languages somebody added
    assert best(accepted) == code


@given(st.text(max_size=200))
def test_no_header_breaks_the_choice(accepted: str) -> None:
    assert best(accepted) in language.CODES


def test_numbers_and_dates_as_the_language_writes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    try:
        with language.using("de"):
            assert language.localised("96.2 % at 1.25 s") == "96,2 % at 1,25 s"
            assert language.when("2026-12-01T08:05:00Z") == "01 Dez. 2026, 09:05"
            assert language.zone("2026-07-01T08:05:00Z") == "UTC+2"
        assert (
            language.localised("96.2 %") == "96.2 %" and language.when("2026-12-01T08:05:00Z") == "01 Dec 2026, 09:05"
        )
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A German of six messages, so that these tests do not depend on how the catalogue puts it."""
    made = Catalog(locale="de")
    for message, translation in {
        "Fatigue": "Ermüdung",
        "the plateau is %(share)s lower": "das Plateau ist %(share)s tiefer",
        "Its error is %(times)s times the noise.": "Sein Fehler ist das %(times)sfache des Rauschens.",
        "%(name)s: it raises the error on held-out rows.": "%(name)s: es erhöht den Fehler.",
        "load cell: nothing for %(value)s s": "Kraftsensor: nichts seit %(value)s s",
        "The fit is good.": "Die Anpassung ist gut.",
    }.items():
        made.add(message, translation)
    monkeypatch.setattr(words, "catalogue", lambda _code: made)
    monkeypatch.setattr(translated_module(), "catalogue", lambda _code: made)
    forget()
    yield
    monkeypatch.undo()
    forget()


def translated_module() -> Any:
    import importlib

    return importlib.import_module("stimrig.api.language.translated")


def forget() -> None:
    module = translated_module()
    for cached in (words.translations, module._certain, module._message, module._patterns, module._same):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("given_text", "expected"),
    [
        ("Fatigue", "Ermüdung"),
        ("fatigue", "Ermüdung"),
        ("The plateau is 12.5 % lower.", "Das Plateau ist 12,5 % tiefer."),
        (
            "The fit is good. Its error is 1.3 times the noise.",
            "Die Anpassung ist gut. Sein Fehler ist das 1,3fache des Rauschens.",
        ),
        ("Fatigue: it raises the error on held-out rows.", "Ermüdung: es erhöht den Fehler."),
        (
            "load cell: nothing for 0.5 s; the plateau is 3 % lower",
            "Kraftsensor: nichts seit 0,5 s; das Plateau ist 3 % tiefer",
        ),
        ("12.5", "12,5"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("small")
def test_a_sentence_made_elsewhere_is_written_by_its_pattern(given_text: str, expected: str) -> None:
    with language.using("de"):
        assert str(translated(given_text)) == expected


@pytest.mark.usefixtures("small")
def test_what_has_no_translation_stays_and_is_marked_as_english() -> None:
    with language.using("de"):
        assert translated("Who knows <b>this</b>?") == '<span lang="en">Who knows &lt;b&gt;this&lt;/b&gt;?</span>'
    assert translated("Who knows <b>this</b>?") == "Who knows <b>this</b>?"


@pytest.mark.usefixtures("small")
@given(st.text(max_size=300))
def test_no_text_breaks_a_translation(text: str) -> None:
    with language.using("de"):
        assert isinstance(translated(text), str)


def test_sentences_of_the_source_become_patterns() -> None:
    source = (
        '"""A docstring of words."""\n'
        'x = f"the plateau is {share:.1%} of {a.b} and {f(1)}, 5 %"\n'
        'log.info("not for people at all")\n'
    )
    assert list(extract.sentences(source)) == ["the plateau is %(share)s of %(b)s and %(value)s, 5 %%"]


def forms_of(text: Any) -> tuple[str, ...]:
    """One form, or those for one and for many."""
    return (text,) if isinstance(text, str) else tuple(text)


@pytest.mark.parametrize("code", [code for code in language.CODES if code != language.DEFAULT])
def test_every_message_has_its_translation(code: str) -> None:
    """`python -m stimrig.api.language.extract --check` says the same; `make words` renews the catalogues."""
    assert extract.missing(code) == []


@pytest.mark.parametrize("code", [code for code in language.CODES if code != language.DEFAULT])
def test_translations_keep_the_places(code: str) -> None:
    wrong = []
    for entry in words.catalogue(code):
        if not entry.id:
            continue
        wanted = {place for form in forms_of(entry.id) for place in PLACE.findall(form)}
        strings = [set(PLACE.findall(text)) for text in forms_of(entry.string) if text]
        if any(not places <= wanted for places in strings) or any(places != wanted for places in strings[-1:]):
            wrong.append(entry.id)
    assert wrong == []


def test_a_catalogue_is_one_file_and_ships() -> None:
    assert {path.stem for path in words.HERE.glob("*.po")} | {"en"} == set(language.CODES)
    assert '"*.po"' in (Path(__file__).parents[2] / "pyproject.toml").read_text()


@pytest.mark.parametrize("code", ["xq", "pt_BR", "../de", "--renew"])
def test_no_catalogue_is_begun_for_what_is_no_language(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert extract.main([code]) == 2
    assert "no language" in capsys.readouterr().err and words.CODES == language.CODES
