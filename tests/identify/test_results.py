"""Results show themselves in a few lines with units, and hold exactly the keys that their schemas describe."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from stimrig import identify
from stimrig.identify.methods import methods
from stimrig.identify.model_schema import SCHEMA
from stimrig.identify.summary import estimate, quantity
from tests.harness import few_effects
from tests.identify import hidden_muscles
from tests.identify.dear import fatigued, improved_with_a_delay

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
def record():
    return fatigued()


@cache
def made() -> dict[str, Any]:
    model = identify.fit(fatigued())
    with few_effects.only("fatigue", "potentiation", "recruitment_hysteresis"):
        diagnosis = identify.diagnose(fatigued())
    return {
        "model": model,
        "comparison": identify.compare(model, fatigued()),
        "diagnosis": diagnosis,
        "improvement": improved_with_a_delay(),
    }


@pytest.fixture
def results() -> dict[str, Any]:
    return dict(made())


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


def test_rivals_and_the_test_between_them_keep_to_the_schema(record, monkeypatch):
    """Every effect that was tried is made a rival, so that there is a test to plan."""
    monkeypatch.setattr(import_module("stimrig.identify.diagnosis.result"), "RIVAL", 0.0)
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
    for key in ("fit", "quality", "valid_for", "data", "created", "model_id", "noise", "effects"):
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


def test_an_estimate_without_a_deviation_has_no_plus_minus():
    assert estimate(0.5284, 0.0123, "s") == "0.528 ± 0.012 s" and estimate(0.64, 0.01, "1") == "0.64 ± 0.01"
    assert estimate(2.0, None, "s") == estimate(2.0, float("nan"), "s") == "2 s"
