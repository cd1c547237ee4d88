"""A person reads an effect's title in the page's language; its id stays in titles, links and REST."""

from __future__ import annotations

import re

from api import language
from api.effect_words import EFFECTS, PARAMETERS, effects_words, without_unit
from api.language import translated
from api.models import explanation, headline, trend_words
from identify import effects
from tests.api.conftest import Service, run_test, shared_service
from tests.api.test_access import signed_in

PLAIN = {
    "sample_rate_hz": 40.0,
    "linear": {"b": [0.0, 0.002], "a": [1.0, -1.93, 0.934], "delay_samples": 0},
    "recruitment": {"pulse_width_us": [0.0, 100.0, 300.0], "torque_nm": [0.0, 1.0, 2.0]},
}


service = shared_service()


def test_titles_and_main_parameters_are_those_of_the_library() -> None:
    """An effect that is not in the table is told by its id in words: adding one touches no other file."""
    with language.using("en"):
        named = {entry["id"]: entry["name"] for entry in effects.library()}
        assert {effect: str(words) for effect, words in EFFECTS.items()}.items() <= named.items()
    for entry in effects.library():
        for form in entry["forms"] if entry["id"] in EFFECTS else ():
            held = {"id": entry["id"], "parameters": {one["name"]: 1.0 for one in form["parameters"]}}
            (figure,) = [name for name in headline.of(PLAIN | {"effects": [held]}) if "." in name]
            assert without_unit(figure.partition(".")[2]) in PARAMETERS, figure


def test_words_in_german() -> None:
    with language.using("de"):
        assert effects_words(["fatigue:by_pulses", "mains_hum"]) == "Ermüdung (by pulses), Netzbrummen"
        assert trend_words.name_of("fatigue.depth", "1").words == "Ermüdung, Tiefe"
        assert translated("recruitment_hysteresis: the evidence is too weak (log evidence +0.3): what it explains "
                          "looks like noise.").startswith("Hysterese der Rekrutierung: ")  # fmt: skip
        for effect in EFFECTS:
            assert translated(effect) not in (effect, f'<span lang="en">{effect}</span>') or effect == "tremor"


def test_a_parameter_is_told_by_what_it_is() -> None:
    library = {entry["id"]: entry for entry in effects.library()}
    given = {name: {"value": 1.0, "sd": 0.1, "unit": "1"} for name in ("depth", "onset_s")}
    found = explanation.card({"effect": "fatigue", "parameters": given}, library)["parameters"]
    assert found["depth"]["label"] == "largest share of torque that is lost"
    assert found["onset_s"]["symbol"] == "onset", "as the equation calls it"
    assert explanation.card({"effect": "own", "parameters": {"my_gain_nm": {}}}, {})["parameters"] == {
        "my_gain_nm": {"label": "my gain", "symbol": "my_gain"}
    }


def test_what_was_added_and_rivals_are_told_by_their_titles() -> None:
    row = {"id": "M-1", "added_effect": "fatigue,threshold_drift"}
    rival = {"effect": "fatigue", "confused_with": ["threshold_drift"]}
    library = {entry["id"]: entry for entry in effects.library()}
    with language.using("de"):
        assert explanation.label(row) == "+ Ermüdung, Drift der Rekrutierungsschwelle"
        for known in ({}, library):
            assert explanation.card(rival, known)["rivals"] == ["Drift der Rekrutierungsschwelle"]


def test_no_page_shows_an_id(service: Service) -> None:
    with service.client() as http:
        http.post("/v1/participants", json={"code": "E1"})
        other, plain = (run_test(http, "E1")["model_id"] for _ in range(2))
        body = {"effects": ["threshold_drift"], "force": True, "reason": "seen last week"}
        added = http.post(f"/v1/models/{plain}/effects", json=body)
        assert added.status_code == 201, added.text
        better = added.json()["id"]
    pages = ("/participants/E1", "/participants/E1/trend", f"/compare?model={better}&model={other}",
             f"/models/{better}", f"/models/{better}/report")  # fmt: skip
    with signed_in(service) as browser:
        browser.cookies.set("stimrig_language", "de")
        for place in pages:
            page = browser.get(place).text
            assert 'lang="de"' in page
            shown = re.sub(r"<script\b.*?</script>|<[^>]*>", " ", page, flags=re.DOTALL)
            assert not re.search(r"(?i)threshold[_ ]drift|recruitment threshold", shown), place
            assert "Drift der Rekrutierungsschwelle" in shown, place
