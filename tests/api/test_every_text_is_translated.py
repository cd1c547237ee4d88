"""The pages in a made-up language that puts each message in brackets: a text without brackets is not translated."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import httpx
import pytest
from babel.messages.catalog import Catalog

from stimrig.api import language
from stimrig.api.language import extract
from tests.api.conftest import STUB, Service, run_service, run_test
from tests.api.test_access import csrf, signed_in
from tests.api.test_languages import forget

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
    names = ("words", "translated")
    modules = [importlib.import_module(f"stimrig.api.language.{name}") for name in names]
    pages = [importlib.import_module(name) for name in ("stimrig.api.language", "stimrig.api.web.pages.rig_view")]
    with pytest.MonkeyPatch.context() as patch:
        for module in [*modules, *pages]:
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
def places(service: Service) -> dict[str, str]:
    """Addresses of the pages, of a participant with two tests."""
    with service.client() as http:
        for code in ("X1", "X2"):
            http.post("/v1/participants", json={"code": code})
        first, second = (run_test(http, "X1") for _ in range(2))
        model, other = first["model_id"], second["model_id"]
        http.get(f"/v1/models/{model}/diagnosis")
        http.post(f"/v1/models/{model}/approve", json={"reason": "follows the measurement well"})
    return {
        "home": "/", "new participant": "/participants/X2", "participant": "/participants/X1",
        "model": f"/models/{model}", "other model": f"/models/{other}", "test": f"/tests/{first['id']}",
        "calibration": "/participants/X1/calibration", "trend": "/participants/X1/trend",
        "compare": f"/compare?model={model}&model={other}", "report": f"/models/{model}/report",
        "administration": "/administration", "sign-in": "/sign-in", "nothing": "/models/none",
    }  # fmt: skip


PAGES = (
    "home", "new participant", "participant", "model", "other model", "test", "calibration", "trend", "compare",
    "report", "administration", "sign-in", "nothing",
)  # fmt: skip


@pytest.mark.parametrize("name", PAGES)
def test_every_text_of_a_page_is_a_message(name: str, browser: httpx.Client, places: dict[str, str]) -> None:
    answer = browser.get(places[name], headers={"Accept": "text/html"})
    assert answer.headers["content-language"] == MADE_UP and answer.status_code in (200, 404)
    assert untranslated(answer.text) == [], "\n".join(untranslated(answer.text))


def test_the_question_before_a_test_is_translated(browser: httpx.Client, places: dict[str, str]) -> None:
    seen = re.findall(r'name="seen" value="([^"]+)"', browser.get("/participants/X1").text)[0]
    form = {"csrf": csrf(browser), "seen": seen}
    asked = browser.post("/participants/X1/tests", data=form, follow_redirects=True)
    assert "/confirm/" in str(asked.url), places
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
