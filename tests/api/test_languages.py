"""The languages of the pages: which one is taken, how numbers and dates are written, what is translated and how."""

from __future__ import annotations

import importlib
import re
import shutil
import time
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import httpx
import pytest
from babel.messages.catalog import Catalog
from hypothesis import given
from hypothesis import strategies as st

from stimrig.api import language
from stimrig.api.effect_words import effects_words
from stimrig.api.language import best, extract, translated
from stimrig.api.language.translated import PERSON, of
from stimrig.api.models import advice
from stimrig.api.store.tables import Model
from stimrig.identify.effects import find_effect
from stimrig.rig.limits import HARD_LIMITS
from tests.api.conftest import STUB, Service, csrf, run_service, run_test, signed_in

PLACE = re.compile(r"%\((\w+)\)s|(?<!%)%(?![%(])|\{\w+\}")
LANGUAGES = [code for code in language.CODES if code != language.DEFAULT]


@pytest.mark.parametrize(
    ("accepted", "code"),
    [
        ("de", "de"), ("de-AT,de;q=0.9,en;q=0.5", "de"), ("en-US,en;q=0.9,de;q=0.8", "en"), ("fr,de;q=0.2", "de"),
        ("fr", "en"), ("", "en"), ("*", "en"), ("de;q=0", "en"), ("de;q=x", "en"), ("q" * 5000, "en"),
    ],
)  # fmt: skip
def test_the_browsers_language_is_taken_where_there_is_one(accepted: str, code: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(language, "CODES", ("en", "de"))  # whatever other languages somebody added
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
        "%(name)s: it raises the error on held-out pulses.": "%(name)s: es erhöht den Fehler.",
        "load cell: nothing for %(value)s s": "Kraftsensor: nichts seit %(value)s s",
        "The fit is good.": "Die Anpassung ist gut.",
    }.items():
        made.add(message, translation)
    monkeypatch.setattr(language, "catalogue", lambda _code: made)
    monkeypatch.setattr(MODULE, "catalogue", lambda _code: made)
    forget()
    yield
    monkeypatch.undo()
    forget()


MODULE: Any = importlib.import_module("stimrig.api.language.translated")
"""The package has a function of this name."""


def forget() -> None:
    for cached in (language.translations, *vars(MODULE).values()):
        if hasattr(cached, "cache_clear"):
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
        ("Fatigue: it raises the error on held-out pulses.", "Ermüdung: es erhöht den Fehler."),
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
        'self._log.info("nor is what an object logs")\n'
    )
    assert list(extract.sentences(source)) == ["the plateau is %(share)s of %(b)s and %(value)s, 5 %%"]


def forms_of(text: Any) -> tuple[str, ...]:
    """One form, or those for one and for many."""
    return (text,) if isinstance(text, str) else tuple(text)


@pytest.mark.parametrize("code", LANGUAGES)
def test_every_message_has_its_translation(code: str) -> None:
    """`python -m stimrig.api.language.extract --check` says the same; `make words` renews the catalogues."""
    assert extract.missing(code) == []


def test_no_page_takes_the_muscle_for_one_of_the_arm() -> None:
    """But for where a number of the rig's limits comes from, and a sentence that is stored with diagnoses."""
    elbows = {text for limit in HARD_LIMITS.values() for text in (limit.reason, limit.source)}
    elbows.add(find_effect("torque_angle").plain)
    joint = re.compile(r"(?<!re-)(?<!lever )(?<!moment )\b(?:arms?|forearms?|elbows?)\b", re.IGNORECASE)
    assert {text for text in map(language.first, extract.messages()) if joint.search(text)} <= elbows


@pytest.mark.parametrize("code", LANGUAGES)
def test_translations_keep_the_places(code: str) -> None:
    wrong = []
    for entry in language.catalogue(code):
        if not entry.id:
            continue
        wanted = {place for form in forms_of(entry.id) for place in PLACE.findall(form)}
        strings = [set(PLACE.findall(text)) for text in forms_of(entry.string) if text]
        if any(not places <= wanted for places in strings) or any(places != wanted for places in strings[-1:]):
            wrong.append(entry.id)
    assert wrong == []


def test_a_catalogue_is_one_file_and_ships() -> None:
    assert {path.stem for path in language.HERE.glob("*.po")} | {"en"} == set(language.CODES)
    assert '"*.po"' in (Path(__file__).parents[2] / "pyproject.toml").read_text()


@pytest.mark.parametrize("code", ["xq", "pt_BR", "../de", "--renew"])
def test_no_catalogue_is_begun_for_what_is_no_language(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert extract.main([code]) == 2
    assert "no language" in capsys.readouterr().err and not (language.HERE / f"{code}.po").exists()


# ---- sentences that other parts put together: whole, and with all their values ---------------------------------------

NAMED = re.compile(r"%\((\w+)\)s")


@pytest.mark.parametrize("code", LANGUAGES)
def test_each_message_is_recognised_as_itself(code: str) -> None:
    wrong, seen = [], set()
    with language.using(code):
        for entry in language.catalogue(code):
            shape = NAMED.sub("%", str(entry.id))
            if isinstance(entry.id, str) and entry.id and entry.string and shape not in seen:
                seen.add(shape)
                values = {
                    name: "Ben Carter" if name == PERSON else f"Zq{k}" if k % 2 else f"{k}7"
                    for k, name in enumerate(NAMED.findall(entry.id))
                }
                given, expected = (text % values if values else text for text in (entry.id, str(entry.string)))
                wrong += [(given, of(code, given))] if of(code, given) != expected else []
    assert wrong == []


@pytest.mark.parametrize("code", LANGUAGES)
@pytest.mark.parametrize(
    "sentence",
    [
        "Nothing is missing: what is left is noise",
        "Fatigue is very probably missing (99 %). The muscle tires: the longer it has worked, the less torque the same "
        "pulse gives. It recovers at rest. After a stroke, muscles tire sooner. Late in a session the muscle needs "
        "more charge, or longer rests. This record cannot clearly separate it from: potentiation, drift of the "
        "baseline. To decide: The ramp repeated after stimulation, and once more after a rest.",
        "data.csv, line 1: column 'Time' is taken for time_s, but its unit is not said. Give --map time_s=Time:s.",
        "The record gives evidence for: “Fatigue” and “Drift of the baseline”. On held-out pulses the model's error is "
        "1.3 times the noise.",
        "Add “Fatigue”, then “Drift of the baseline” to the model. The next experiment tells it from its rivals.",
        "Nothing more can be learnt from this record alone. Fatigue: log evidence would rise by 40 with it, too little "
        "beside all that is explained, too much for chance. Play the next experiment: it is planned to decide.",
        "Nothing more can be learnt from this record alone. 2 effects are possibly missing in this model. Add nothing "
        "yet: held-out pulses speak against adding any.",
        "Most of it is here: rising prbs, 100-200 µs: model too low by 0.12 N·m, 34 % of the error above the noise.",
        "Do not use this model: the fit of 20.0 % is too poor: the torque hardly follows the pulses.",
        "Check this before use: on held-out pulses the fit is 80.1 %, and the noise allows 96.3 %: something is "
        "missing; see the diagnosis.",
        "Valid for pulse widths of 100–300 µs, torques down to -5.0 N·m, 40–40 pulses/s.",
        "A fast ramp (20 s) should separate fatigue from potentiation.",
        "charge_per_phase_uc 12 µC is outside 0 … 10 (hard limit, over by 2): own rule",
        "There is no participant 'P99'. POST /v1/participants makes one.",
        "latched: stop pressed; the stimulator, asked now: stopped",
    ],
)
def test_a_sentence_put_together_keeps_no_english(code: str, sentence: str) -> None:
    with language.using(code):
        found = of(code, sentence)
    assert found is not None
    english = (
        r"\b(is|are|the|of|with|taken|to|without|too|it|something|possibly|more|missing|rising|low|and|from|over)\b"
    )
    assert not re.search(english, found), found
    assert re.findall(r"\d+", found) == re.findall(r"\d+", sentence)


@pytest.mark.parametrize("code", LANGUAGES)
def test_english_stays_only_in_a_sentence_that_is_surely_meant(code: str) -> None:
    with language.using(code):
        assert "[Errno 19] No such device" in str(
            of(code, "load cell on can0: the bus was lost: [Errno 19] No such device")
        )
        assert of(code, "A person with a code of its own is seen in the morning.") is None
        assert language._("") == "" and of(code, ": Who knows") is None, "the catalogue's head is no message"


@pytest.mark.parametrize("code", LANGUAGES)
def test_a_text_of_many_half_sentences_is_given_up(code: str) -> None:
    """Without a bound, the parts of this text that may be messages are looked up for minutes."""
    pieces = ("the", "is", "at", "of", ".", ":", ";", ",", "and", "from", "with", "in", "torque", "test", "N·m", "s")
    text = " ".join(pieces[(7 * k + k // 5) % len(pieces)] for k in range(400))
    with language.using(code):
        assert of(code, text) is None


def test_an_effects_title_stands_after_a_colon_and_quotes_are_german() -> None:
    with language.using("de"):
        within = language._("with %(effects)s", effects=effects_words(["activation_dependent_speed"]))
        assert within == "mit: Von der Aktivierung abhängige Geschwindigkeit"
        assert "„Ermüdung“" in advice.advice("usable", [], ["Fatigue"]).words


@pytest.mark.parametrize("code", LANGUAGES)
def test_renewing_a_catalogue_loses_nothing(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"{code}.po"
    shutil.copy(language.HERE / path.name, path)
    before = {str(entry.id): entry.string for entry in language.catalogue(code)}
    head = language.catalogue(code).header_comment
    for module in (language, extract):
        monkeypatch.setattr(module, "HERE", tmp_path)
    monkeypatch.setattr(extract, "CODES", (language.DEFAULT, code))
    language.catalogue.cache_clear()
    try:
        extract.main([])
        language.catalogue.cache_clear()
        after = language.catalogue(code)
        assert {str(entry.id): entry.string for entry in after if entry.id and entry.string}.items() <= before.items()
        assert after.header_comment == head and sum(1 for entry in after if entry.string) > 500
    finally:
        language.catalogue.cache_clear()


HOSTILE = [
    "  " * 23 + " is outside " + " … " * 22 + " (" * 37,
    "a " * 300 + " is outside " + " … " * 150 + " (" * 150,
    "a " * 400 + " is above the participant's " + "b " * 400,
    "c: " * 300 + " must be at least " + "d " * 300,
    "ready, " * 280,
    "P is of P, P of P. " * 100,
    "calibration: " * 60 + "at at µs is above ; mark " * 40,
]
"""What anybody may type into an address, a reason or a note, and a message repeats."""


@pytest.mark.parametrize("code", LANGUAGES)
@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_no_text_keeps_the_service_busy(code: str, text: str) -> None:
    of(code, "ready")  # the catalogue is read
    begun_s = time.process_time()
    of(code, text)
    assert time.process_time() - begun_s < 5.0, "seconds in the loop that also takes the stop; it was minutes once"


def test_no_attribute_holds_what_may_be_marked_as_english() -> None:
    """`translated` may give an element, `plain_words` does not."""
    folder = Path(language.__file__).parents[1] / "web" / "pages" / "templates"
    wrong = [path.name for path in folder.glob("*.html") if re.search(r'="[^"]*\|translated', path.read_text("utf-8"))]
    assert wrong == []


@pytest.mark.parametrize("who", ["Ada", "Änne Weiß", "Anna Maria von Berg"])
def test_who_stopped_may_have_a_name_of_several_words(who: str):
    assert of("de", f"stop pressed on the page (by {who}).") == f"Stopp auf der Seite gedrückt (durch {who})."


@pytest.mark.parametrize(("english", "german"), [
    ("1 acknowledgement came late, 40 ms after the pulse was sent; this pulse may have been felt that late; 1 pulse "
     "that came due meanwhile was dropped",
     "1 Bestätigung kam verspätet, 40 ms nach dem Senden des Pulses; dieser Puls kann so viel später gespürt "
     "worden sein; 1 inzwischen fälliger Puls wurde ausgelassen"),
    ("2 acknowledgements came late, up to 40 ms after the pulse was sent; these pulses may have been felt that late; 0 "
     "pulses that came due meanwhile were dropped", "2 Bestätigungen kamen verspätet, bis zu 40 ms nach dem Senden des "
     "Pulses; diese Pulse können so viel später gespürt worden sein; 0 inzwischen fällige Pulse wurden ausgelassen"),
])  # fmt: skip
def test_one_of_a_kind_is_told_as_one_in_german(english: str, german: str):
    assert of("de", f"stimulator: {english}") == f"Stimulator: {german}"


def test_what_confirms_a_stop_is_told_in_german():
    told = of("de", "device: not initialised; torque fell from 9 to 4 N·m")
    assert told == "Gerät: gibt keine Pulse ab (nicht initialisiert); das Drehmoment fiel von 9 auf 4 N·m"


# ---- The pages in a made-up language that puts each message in brackets: a text without brackets is not translated


MADE_UP = "fr"
"""A locale that babel knows and the pages do not have."""
NO_WORDS = re.compile(
    r"stimrig|MODEL\.json|HDF5|CSV|PDF|JSON|REHASTIM2|UTC|Ada|N·m(·s)?|Tω|English|Deutsch|[Ff]rançais|"
    r"\b\d{1,2} [a-zéû]+\.?( \d{4})?(?=\W|$)|FAKE P24|fake cell|prbs|ramp|validate|maximum-likelihood|"
    r"SHA-256|Little is left to explain|falling prbs, 0-300 µs: model too high|of the error above the noise|"
    r"[A-Z]\d{8}T\d{6}-\w+|\bT1-\w+"
)
"""Names, units, file formats and technical terms: the same in every language. Dates are written by babel.

And the sentences of the stub worker, which no source has."""
VOID = {"input", "meta", "link", "img", "br", "hr", "col", "wbr", "source"}


@pytest.fixture(scope="module")
def made_up() -> Iterator[None]:
    """The language, and no other besides English."""
    made = Catalog(locale=MADE_UP)
    for message in extract.messages():
        if message:
            one = f"⟦{message}⟧" if isinstance(message, str) else tuple(f"⟦{form}⟧" for form in message)
            made.add(message, one)
    names = ("language", "language.translated", "web.pages.rig_view")
    with pytest.MonkeyPatch.context() as patch:
        for module in [importlib.import_module(f"stimrig.api.{name}") for name in names]:
            patch.setattr(module, "CODES", ("en", MADE_UP), raising=False)
            patch.setattr(module, "catalogue", lambda _code: made, raising=False)
        forget()
        yield
    forget()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, short_dir: Path, made_up: None) -> Iterator[Service]:
    yield from run_service(tmp_path_factory.mktemp("words"), short_dir, STUB, speed=30.0)


@pytest.fixture(scope="module")
def browser(service: Service) -> Iterator[httpx.Client]:
    with signed_in(service) as client:
        client.headers["Accept-Language"] = MADE_UP
        yield client


@pytest.fixture(scope="module")
def ids(service: Service) -> dict[str, str]:
    """Of a participant with two tests, what its pages' addresses name."""
    with service.client() as http:
        for code in ("X1", "X2", "X3"):
            http.post("/v1/participants", json={"code": code})
        http.post("/v1/participants/X3/archive")
        first, *more = (run_test(http, "X1") for _ in range(3))
        model, (other, poor) = first["model_id"], (test["model_id"] for test in more)
        fit = service.context.store.get(Model, poor).fit
        service.change(Model, poor, fit={**fit, "verdict": "not usable"})
        http.get(f"/v1/models/{model}/diagnosis")
        http.post(f"/v1/models/{model}/approve", json={"reason": "follows the measurement well"})
    return {"model": model, "other": other, "poor": poor, "test": first["id"]}


PAGES = (
    "/", "/participants/X2", "/participants/X1", "/models/{model}", "/models/{other}", "/tests/{test}",
    "/participants/X1/calibration", "/participants/X1/trend", "/compare?model={model}&model={other}",
    "/models/{model}/report", "/administration", "/sign-in", "/models/none", "/participants/X3",
    "/participants/X1/electrodes", "/models/{poor}/approve", "/models/{model}/widths", "/participants/X1/joint",
    "/rig/angle", "/jobs/none", "/participants/none", "/compare", "/models/{model}/story",
)  # fmt: skip


@pytest.mark.parametrize("page", PAGES)
def test_every_text_of_a_page_is_a_message(page: str, browser: httpx.Client, ids: dict[str, str]) -> None:
    answer = browser.get(page.format(**ids), headers={"Accept": "text/html"})
    assert answer.headers["content-language"] == MADE_UP and answer.status_code in (200, 404, 409, 422)
    assert untranslated(answer.text) == [], "\n".join(untranslated(answer.text))


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_one_first_button_at_most(page: str, browser: httpx.Client, ids: dict[str, str]) -> None:
    assert len(first_buttons(browser.get(page.format(**ids)).text)) <= 1


def test_with_nobody_but_a_token_the_first_button_is_the_tokens(browser: httpx.Client) -> None:
    (first,) = first_buttons(browser.get("/sign-in").text)
    assert "token" in first


def test_in_a_calibration_and_beside_a_running_test_there_is_one_first_button(
    service: Service, browser: httpx.Client, ids: dict[str, str]
) -> None:
    page = browser.get("/participants/X2").text
    form = {"csrf": csrf(browser), "seen": re.findall(r'name="seen" value="([^"]+)"', page)[0]}
    begun = browser.post("/participants/X2/calibration", data=form)
    calibrating = browser.get(begun.headers["location"]).text
    refused = browser.post("/participants/X1/calibration", data=form)
    assert [refused.status_code, len(first_buttons(calibrating)), len(first_buttons(refused.text))] == [409, 1, 1]
    (version,) = set(re.findall(r'name="calibration" value="([^"]+)"', calibrating))
    ended = browser.post("/participants/X2/calibration/discard", data={**form, "calibration": version})
    assert ended.status_code == 303, ended.text


def first_buttons(html: str) -> list[str]:
    return re.findall(r'<(?:a|button)[^>]*class="[^"]*\bprimary\b[^>]*>([^<]*)<', html)


def test_the_question_before_a_test_is_translated(browser: httpx.Client, ids: dict[str, str]) -> None:
    seen = re.findall(r'name="seen" value="([^"]+)"', browser.get("/participants/X1").text)[0]
    form = {"csrf": csrf(browser), "seen": seen}
    asked = browser.post("/participants/X1/tests", data=form, follow_redirects=True)
    assert "/confirm/" in str(asked.url), ids
    assert untranslated(asked.text) == []


def untranslated(html: str) -> list[str]:
    """Texts, and texts of attributes, that are in no brackets and hold a word."""
    reader = Texts()
    reader.feed(html)
    return [text for text in reader.found if re.search(r"[A-Za-z]{3}", NO_WORDS.sub("", text))]


def outside(text: str, deep: int = 0) -> tuple[str, int]:
    """What stands outside of all brackets, and how many are open at the end: a message may hold marks of its own."""
    found = []
    for sign in text:
        deep += (sign == "⟦") - (sign == "⟧")
        found.append(sign if not deep and sign != "⟧" else "")
    return "".join(found), deep


class Texts(HTMLParser):
    """All that a person reads or hears; names, addresses and what is marked as English are left out."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[tuple[str, bool]] = []
        self.found: list[str] = []
        self.deep = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        kept = tag in ("script", "style") or "mono" in (given.get("class") or "").split()
        kept = kept or given.get("translate") == "no" or (tag == "span" and given.get("lang") == "en")
        if not self._silent():
            texts = (given.get(name) or "" for name in ("title", "aria-label", "placeholder", "alt"))
            self.found += [outside(text)[0] for text in texts]
        if tag not in VOID:
            self.open.append((tag, kept))

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open.pop()[0] != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not self._silent():
            text, self.deep = outside(data, self.deep)
            self.found.append(" ".join(text.split()))

    def _silent(self) -> bool:
        return any(kept for _, kept in self.open)


def test_the_brackets_are_seen_through() -> None:
    html = '<p title="No words">⟦A <b>much</b> ⟦b⟧ c⟧ and more</p><p class="mono">words</p>'
    assert untranslated(html) == ["No words", "and more"]
    assert language.code() == "en"


def test_a_number_takes_in_no_sentence_before_it() -> None:
    """The conclusion stood in the middle of the sentence after it."""
    ended = "Nothing more can be learnt from this record alone."
    with language.using("de"):
        found = of("de", f"{ended} 2 effects are possibly missing in this model.")
        assert found == f"{of('de', ended)} {of('de', '2 effects are possibly missing in this model.')}"
