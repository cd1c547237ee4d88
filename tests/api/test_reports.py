"""Reports and the story as files, and what they say of effects: titles, free effects, repeats, hashes, warnings."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.charts.figure import Figures
from stimrig.api.charts.model_charts import free_effects
from stimrig.api.cli.reports import report_test
from stimrig.api.effect_words import effect_words, library, parameter_words
from stimrig.api.jobs.curves import curves
from stimrig.api.models import explanation, stored_model
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.report_file import comparison_html
from stimrig.identify import effects
from stimrig.identify.healing import healed_places, place_words
from stimrig.identify.json_text import json_value
from tests.api.conftest import Service, run_test
from tests.harness.muscle import Patient
from tests.harness.patients import make_record, ramp

WARNINGS = [
    "load cell: stood at exactly 1.250 N·m through the whole test: is it stuck?",
    "load cell: 1560 samples/s came, the rig file says 1600: times of this recording are in doubt",
]


def test_the_report_names_both_hashes_and_warnings_are_told_in_each_place(
    monkeypatch: pytest.MonkeyPatch, client: httpx.Client, service: Service, pages: httpx.Client, participant: str
) -> None:
    sound = run_test(client, participant)
    service.rig.warnings = WARNINGS
    doubtful = run_test(client, participant)
    for done, told in ((sound, False), (doubtful, True)):
        at = f"/models/{done['model_id']}"
        model, drawn = (client.get(f"/v1{at}/{part}").json() for part in ("file", "curves"))
        shown = {path: pages.get(path).text for path in (f"/tests/{done['id']}", at, f"{at}/report")}
        shown["terminal"] = report_test(done)
        shown["file"] = comparison_html(model, drawn, done["id"], done)
        for place, text in shown.items():
            assert [words in text for words in WARNINGS] == [told, told], place
        assert "of its contents" not in shown[f"{at}/report"]
    told_hash = {"data": {"sha256": "c0ffee" * 11}}
    monkeypatch.setattr(stored_model, "read", lambda row: json.loads(row.document) | told_hash)
    text = pages.get(f"/models/{sound['model_id']}/report").text
    assert "SHA-256 of the file " in text and ", of its contents, as in MODEL.json c0ffeec0ffeec0ff…" in text


def test_the_story_begins_with_what_is_missing_and_ends_with_the_error(
    service: Service, client: httpx.Client, pages: httpx.Client, participant: str
) -> None:
    model = run_test(client, participant)["model_id"]
    client.get(f"/v1/models/{model}/diagnosis")
    first = pages.get(f"/models/{model}/story.html").text
    assert "What is missing" in first and "The held-out error is" in first and "To decide between" in first
    (service.data / "recordings" / "slow").write_text("0.5")  # a search that began now would stand still
    last = client.post(f"/v1/models/{model}/improve", timeout=30).json()["versions"][-1]["id"]
    (service.data / "recordings" / "slow").unlink()
    client.get(f"/v1/models/{last}/diagnosis")
    told = pages.get(f"/models/{last}/story.html")
    assert told.headers["content-disposition"] == "attachment" and told.text.count('class="still"') == 3
    assert "The held-out error did not fall" in told.text and "What was missing" in told.text


@pytest.mark.parametrize(
    ("left_nm", "healed", "words"),
    [
        (0.1, True, "fell"), (0.5, False, "more than the noise"), (1.0, False, "as before"),
        (1.1, False, "rose from 1 to 1.1"), (0.9999, False, "is 1 N·m, as before"),
    ],
)  # fmt: skip
def test_a_place_is_healed_where_only_noise_is_left_there(left_nm: float, healed: bool, words: str) -> None:
    times, place = [0.0, 0.5, 1.0, 1.5], {"start_s": 0.0, "end_s": 0.6, "text": "ramp"}

    def comparison(*residual_nm: float) -> dict[str, Any]:
        return {"noise_sd_nm": 0.1, "where": [place], "series": {"time_s": times, "residual_nm": list(residual_nm)}}

    (found,) = healed_places(comparison(1.0, -1.0, 0.0, 0.0), comparison(left_nm, -left_nm, 9.0, 9.0))
    assert (found["before_nm"], found["after_nm"], found["healed"]) == (1.0, left_nm, healed)
    assert words in place_words(found)


def test_what_repeats_stands_in_a_report_and_in_a_model() -> None:
    rest = np.zeros(120)
    widths = np.concatenate([rest, ramp(6), rest, ramp(6), rest])
    names = ["rest"] * 120 + ["ramp"] * 240 + ["rest"] * 120 + ["validate"] * 240 + ["rest"] * 120
    patient = Patient(time_constant_s=0.12)
    record, _ = make_record(patient, np.random.default_rng(1), rate_hz=100, pulses=(widths, names))
    model = identify.fit(record)
    document = model.to_dict()
    page = comparison_html(document, json_value(curves(model, record)), "a record")
    assert "Between 2 repeats of the same pulses the torque differs by" in page
    assert "Between 2 repeats" in str(model)
    assert "contradict each other" not in page
    pair = {"parts": ["prbs", "ramp"], "pulse_width_us": [80.0, 80.0], "direction": "rising", "start_s": 1.0}
    pair |= {"end_s": 1.5, "largest_nm": -0.3, "largest_error_nm": 0.02}
    document["fit"]["contradiction"] = {"significant": True, "false_alarm_rate": 0.05, "pairs": [pair]}
    page = comparison_html(document, json_value(curves(model, record)), "a record")
    assert "contradict each other at 80 µs rising, 1.0-1.5 s: fitted to prbs alone" in page


def test_what_an_effect_says_of_itself_is_read_from_its_file_as_it_is_loaded() -> None:
    """Its title, whether it is of the muscle, and each form's main parameter with a name: in its own file alone."""
    linear = {"b": [0.0, 0.002], "a": [1.0, -1.93, 0.934], "delay_samples": 0}
    plain = {"sample_rate_hz": 40.0, "linear": linear, "uncertainty": {"figures": {}}}
    for effect, known in effects.registry().items():
        said = {"name": effect_words(effect), "muscle": True, "main": {}} | library().get(effect, {})
        assert (said["name"], said["muscle"], said["main"]) == (known.name, known.muscle, known.main)
        assert all(parameter_words(parameter) == words for parameter, words in known.main.items()), effect
        for form in known.forms:
            held = {"id": effect, "parameters": {one.name: {"value": 1.0, "sd": None} for one in form.parameters}}
            (figure,) = [name for name in stored_model.muscle_figures(plain | {"effects": [held]}) if "." in name]
            assert figure.partition(".")[2] in (known.main or {"change"}), figure
    assert set(library()) == {effect for effect, known in effects.registry().items() if not known.shape}


def test_a_model_with_a_free_effect_shows_it() -> None:
    shape = {
        "place": "strength", "driven_by": "torque", "words": "Strength <- torque.", "driver": "time (s)",
        "effect": "opening (1)", "at": [0.0, 0.5],
        "lines": {"opening": {"value": [0.0, 1.0], "lower": [0.0, 0.9], "upper": [0.0, 1.1]}},
    }  # fmt: skip
    free_id = "free_strength_by_torque"
    term = {"id": free_id, "parameters": {"lag_s": {"value": 0.02, "sd": 0.001, "unit": "s"}}, "shape": shape}
    (card,) = explanation.held_free({"effects": [term, {"id": "fatigue"}]})
    drawn, templates = Figures(free_effects([card])), environment.get_template("model_parts.html")
    shown = templates.module.effect(card, drawn)
    assert "Strength &lt;- torque." in shown and f'data-figure="free-{free_id}"' in shown
