"""Results: their steps, their keys as the schemas describe them, and how they show themselves."""

from __future__ import annotations

import dataclasses
import json
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.estimation.uncertainty import prediction_band
from stimrig.identify.methods import methods
from stimrig.identify.model_schema import SCHEMA
from stimrig.identify.summary import certainty, quantity
from tests.harness import few_effects
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "api" / "schemas"
SCHEMAS = {"model": SCHEMA} | {path.stem: json.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob("*.json"))}
RESULTS = ("comparison", "diagnosis", "improvement", "model")
DIAGNOSE = {"noise_sd_nm", "base", "verdict", "missing", "where"}
MISSING = {
    "effect", "probability", "rms_before_nm", "rms_after_nm", "held_out_rms_before_nm", "held_out_rms_after_nm",
    "confused_with", "next_experiment", "parameters",
}  # fmt: skip
STEP = {"added", "fit_percent", "rms_nm", "held_out_rms_nm", "held_out_fit_percent"}
WORDS = "<img src=x onerror=alert(1)> & \"'\n\x1b[31m"


@pytest.fixture(scope="module")
def record() -> identify.Record:
    """A muscle that tires."""
    return hidden_muscles.record("fatigue", seed=15, rate_hz=100)


@pytest.fixture(scope="module")
def results(record: identify.Record) -> dict[str, Any]:
    """Its fatigue is found; improving is asked for a delay, too, that it has not."""
    model = identify.fit(record)
    with few_effects.only("electromechanical_delay", "fatigue", "potentiation"):
        diagnosis = identify.diagnose(record)
        improvement = identify.improve(record, force=["electromechanical_delay"])
    comparison = identify.compare(model, record)
    return {"model": model, "comparison": comparison, "diagnosis": diagnosis, "improvement": improvement}


# ---- api/schemas --------------------------------------------------------------------------------------------


def strict(schema: Any) -> Any:
    """The schema, by which a key that it doesn't describe is an error."""
    if isinstance(schema, list):
        return [strict(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {key: strict(part) for key, part in schema.items()}
    named = isinstance(schema.get("properties"), dict) and "type" in schema
    return {"additionalProperties": False} | closed if named else closed


def errors(name: str, document: dict[str, Any]) -> list[str]:
    """What a document lacks, and what it has beyond its schema."""
    check = jsonschema_rs.Draft202012Validator(strict(SCHEMAS[name]))
    found = json.loads(json.dumps(document, allow_nan=False))
    return [f"{list(error.instance_path)}: {error.message[:200]}" for error in check.iter_errors(found)]


@pytest.mark.parametrize("name", RESULTS)
def test_every_key_of_a_real_result_is_described_and_none_is_missing(results, name):
    assert errors(name, results[name].to_dict()) == []


def test_models_with_effects_and_of_each_method_keep_to_the_schema(results, record):
    models = [*results["improvement"].models, *[identify.fit(record, method=name) for name in methods()]]
    assert [found for model in models if (found := errors("model", model.to_dict()))] == []


def test_nothing_missing_and_nothing_held_out_keep_to_the_schema():
    bare = hidden_muscles.record(seed=13, rate_hz=100, validate=False)
    model = identify.fit(bare)
    assert "cross-validated" in str(model) and "held out" not in repr(model)
    assert errors("model", model.to_dict()) == [] == errors("comparison", identify.compare(model, bare).to_dict())
    with few_effects.only("fatigue", "output_saturation"):
        found = identify.diagnose(bare)
    assert found.verdict == "nothing_missing" and errors("diagnosis", found.to_dict()) == []
    assert found.deciding_experiment is None and identify.next_experiment(found) is None


def test_rivals_and_the_test_between_them_keep_to_the_schema(record, monkeypatch):
    """Every effect that was tried is made a rival, so that there is a test to plan."""
    monkeypatch.setattr(import_module("stimrig.identify.diagnosis.result"), "LEAST_RIVAL", 0.0)
    with few_effects.only("fatigue", "potentiation", "threshold_drift"):
        found = identify.diagnose(record)
    assert found.missing[0]["next_experiment_plan"]["segments"] and errors("diagnosis", found.to_dict()) == []
    assert "cannot separate it from" in str(found) and "next test" in str(found)


def test_the_contracts_keys_are_there(results):
    diagnosis, improvement = results["diagnosis"].to_dict(), results["improvement"].to_dict()
    assert set(diagnosis) >= DIAGNOSE and set(diagnosis["missing"][0]) >= MISSING
    assert set(improvement) >= {"noise_sd_nm", "verdict", "steps"}
    assert all(set(step) >= STEP for step in improvement["steps"])


# ---- for people ---------------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """Tags of a piece of HTML."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        assert {name for name, _ in attrs} <= {"style", "scope"}


@pytest.mark.parametrize("name", RESULTS)
def test_a_summary_is_about_ten_lines_and_prints_itself(results, name):
    found = results[name]
    lines = found.summary().splitlines()
    assert 5 <= len(lines) <= 14 and max(map(len, lines)) < 340
    assert str(found) == found.summary() and "N·m" in found.summary() and "nan" not in found.summary()
    assert "\n" not in repr(found) and len(repr(found)) < 160
    assert lines[0].startswith(name.capitalize()) and repr(found) == f"<{lines[0]}>"


def test_words_of_a_file_stay_words(results):
    """Whatever stands in a MODEL.json or in a recording's names: no tag, no line of its own, no escape sequence."""
    model = results["model"].with_(method=WORDS, model_id=WORDS, quality={"verdict": WORDS}, data={"name": WORDS})
    where = ({**results["comparison"].where[0], "text": WORDS},)
    for found in (
        model.with_(effects=({"id": WORDS, "parameters": {WORDS: {"value": 1.0, "sd": None, "unit": WORDS}}},)),
        dataclasses.replace(results["comparison"], where=where),
        dataclasses.replace(results["diagnosis"], notes=(WORDS,), verdict=WORDS),
        dataclasses.replace(results["improvement"], verdict=WORDS),
    ):
        assert set(Tags(found._repr_html_()).tags) == {"table", "caption", "tbody", "tr", "th", "td"}
        assert "\x1b" not in str(found) + repr(found) and "\n" not in repr(found)
        assert len(str(found).splitlines()) <= 15


def test_a_model_of_another_version_with_little_in_it_still_shows_itself(results):
    bare = results["model"].to_dict()
    for key in ("fit", "quality", "valid_for", "data", "created", "model_id", "noise"):
        del bare[key]
    model = identify.Model.from_dict(bare)
    assert "fit –, held out –" in repr(model) and "recruitment  largest" in str(model)


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [
        (0.04123, "N·m", "0.0412 N·m"), (98.765, "%", "98.8 %"), (12345.6, "µs", "12346 µs"), (0.5, "1", "0.5"),
        (None, "N·m", "–"), (float("nan"), "%", "–"), (float("inf"), "s", "–"), (True, "s", "–"), ("3", "s", "–"),
    ],
)  # fmt: skip
def test_a_number_has_three_digits_and_its_unit(value, unit, said):
    assert quantity(value, unit) == said


# ---- improving: the error falls step by step, and what is not there is refused ----------------------------------


def test_each_step_is_a_model_that_predicts_what_the_step_says(results, record):
    result = results["improvement"]
    for step, made in zip(result.steps, result.models, strict=True):
        model = identify.Model.from_json(made.to_json())
        error = (record.torque_nm - model.predict(record))[record.held_out]
        assert abs(np.sqrt(np.mean(error**2)) - step["held_out_rms_nm"]) < 1e-6
        assert model.model_id == step["model_id"]
    parents = [model.extra["parent"] for model in result.models]
    assert parents == [None, *[model.model_id for model in result.models[:-1]]]


def test_what_is_not_there_is_refused_with_a_reason_and_can_be_forced(results):
    result = results["improvement"]
    assert result.steps[-1]["added"] == "electromechanical_delay"
    assert "on request" in result.steps[-1]["reason"]
    refusals = {row["effect"]: row["reason"] for row in result.refused}
    assert "log evidence" in refusals["electromechanical_delay"]


def held(record: identify.Record, lower: np.ndarray, upper: np.ndarray) -> float:
    """Share of the samples within a band."""
    return float(np.mean((lower <= record.torque_nm) & (record.torque_nm <= upper)))


def test_a_model_with_effects_carries_bands_and_a_verdict():
    """The band holds the muscle's own torque, and without the effect it is far wider; it grows with the noise at most.

    The verdict's gates are those of any model.
    """
    widths, clean = [], hidden_muscles.record("fatigue", seed=5, noise_nm=0.0)
    for noise_nm in (0.03, 0.06):
        record = hidden_muscles.record("fatigue", seed=5, noise_nm=noise_nm)
        fits = identify.fit(record), identify.fit(record, effects=["fatigue"])
        base, model = (identify.Model.from_json(each.to_json()) for each in fits)
        assert model.quality["verdict"] in ("usable", "usable with care")
        assert model.valid_for["pulse_rate_hz"] == [38.0, 42.0]
        lower, upper = prediction_band(model, record)
        assert held(clean, lower, upper) > 0.8
        base_lower, base_upper = prediction_band(base, record)
        assert held(clean, base_lower, base_upper) > 0.7
        assert np.mean(base_upper - base_lower) > 3.0 * np.mean(upper - lower)
        curve = {key: np.asarray(values) for key, values in model.bands["recruitment"].items()}
        true_nm = hidden_muscles.recruited(curve["pulse_width_us"])
        assert np.mean((curve["whole_lower"] <= true_nm) & (true_nm <= curve["whole_upper"])) > 0.85
        assert np.max(np.abs(curve["value"] - true_nm)) < 0.15
        assert np.max(np.abs(np.asarray(base.bands["recruitment"]["value"]) - true_nm)) > 0.5
        widths.append(float(np.mean((upper - lower)[~record.held_out])))
        assert widths[-1] < noise_nm  # the whole band: some two hundred samples a parameter
    # What an inexact form leaves is in the band, too, where the noise does not hide it: it is, in the quieter record.
    assert 0.5 < widths[1] / widths[0] < 2.8


def test_every_step_keeps_what_the_structure_held():
    record = hidden_muscles.record("fatigue", seed=15)
    record = record.with_torque(record.torque_nm + 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s))
    with few_effects.only("baseline_drift", "fatigue", "mains_hum", "tremor"):
        held = identify.fit(record, effects=["baseline_drift:linear"])
        result = identify.improve(record, model=held)
        last = identify.diagnose(record, result.models[-1])
    assert last.verdict == "nothing_missing", "where no effect is left to try, that is no error"
    assert [step["added"] for step in result.steps] == [None, "mains_hum", "fatigue"]
    for model in result.models:
        assert model.effects[0]["id"] == "baseline_drift"


def test_nothing_missing_names_no_worst_place_and_says_when_the_record_is_too_poor_to_tell(results):
    found = dataclasses.replace(results["diagnosis"], verdict="nothing_missing", missing=(), notes=())
    base = {**found.base, "held_out_rms_nm": found.noise_sd_nm}
    calm = str(dataclasses.replace(found, base=base))
    assert "error in" not in calm and "may show what is missing" not in calm
    poor = str(dataclasses.replace(found, base={**base, "held_out_rms_nm": 20 * found.noise_sd_nm}))
    assert "may show what is missing" in poor


def test_an_explanation_states_the_contradiction_of_its_first_and_of_its_last_model(results, record):
    before, after = results["comparison"], identify.compare(results["improvement"].models[-1], record)
    found, calm = results["diagnosis"], {"significant": False, "false_alarm_rate": 0.05, "pairs": []}
    after = dataclasses.replace(after, contradiction=calm)
    for first, last in ((before, after), (after, before)):
        shown = str(identify.Explanation(found, results["improvement"], found, first, last))
        assert ("parts, at first" in shown, "parts, at last" in shown) == (first is before, last is before)


def test_a_name_that_is_doubted_has_not_the_probability_that_structure_is_left():
    doubted = {"verdict": "unexplained_structure", "probability": 0.9, "missing": [{"probability": 0.45}]}
    assert certainty(doubted) == ""
