"""From a record with something hidden in it to a better model's prediction, through the command line alone."""

from __future__ import annotations

import contextlib
import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from stimrig.api.cli import main
from stimrig.api.workers import verbs
from stimrig.hardware_sim import hidden_records
from tests.harness import few_effects

pytestmark = pytest.mark.slow


def stimrig(*words: object) -> str:
    """Standard output of a verb that must succeed; of three effects it finds what is missing."""
    out, err = io.StringIO(), io.StringIO()
    few = few_effects.only("fatigue", "output_saturation", "potentiation")
    with few, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run(list(map(str, words)))
    assert code == 0, err.getvalue()
    return out.getvalue()


@pytest.fixture(scope="module")
def tired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of a muscle that tires, and what `improve` makes of it."""
    folder = tmp_path_factory.mktemp("tired")
    record = hidden_records.generate("fatigue", "strong", seed=41, rate_hz=100, design="short")
    data = folder / "record.csv"
    hidden_records.write_csv(record, data)
    made = ("-o", folder / "better.json", "--html", folder / "report.html")
    (folder / "improved.json").write_text(stimrig("improve", data, *made, "--json"))
    return folder


def test_improve_writes_a_model_that_predicts_better(tired: Path, tmp_path: Path) -> None:
    data, base, better = tired / "record.csv", tmp_path / "base.json", tired / "better.json"
    stimrig("fit", data, "-o", base)
    found = json.loads((tired / "improved.json").read_text())
    assert [step["added"] for step in found["steps"]][:2] == [None, "fatigue"]
    assert found["steps"][1]["rms_nm"] < found["steps"][0]["rms_nm"]
    assert (tired / "report.html").stat().st_size > 1000

    def rms_nm(model: Path) -> float:
        out = tmp_path / f"{model.stem}.csv"
        stimrig("predict", model, data, "-o", out)
        with out.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        assert list(rows[0]) == ["time_s", "torque_nm", "predicted_torque_nm"]
        gap = [float(row["torque_nm"]) - float(row["predicted_torque_nm"]) for row in rows]
        return float(np.sqrt(np.mean(np.square(gap))))

    assert rms_nm(better) < 0.5 * rms_nm(base)


def test_what_a_model_holds_is_not_missing_in_it_and_auto_adds_what_improve_adds(tired: Path, tmp_path: Path) -> None:
    data, held = tired / "record.csv", tmp_path / "held.json"
    fitted = json.loads(stimrig("fit", data, "--effects", "auto", "-o", held, "--json"))
    improved = json.loads((tired / "improved.json").read_text())
    added = [step["added"] for step in improved["steps"][1:]]
    assert [effect["id"] for effect in fitted["effects"]] == added and "fatigue" in added
    forms = [f"{effect['id']} ({effect['form']})" for effect in fitted["effects"]]
    assert f"structure      {', '.join(forms)}\n" in stimrig("diagnose", data, "--model", held)
    own = verbs.diagnosis(str(data), lambda *_: None, held.read_text())
    assert [name.partition(":")[0] for name in own["structure"]] == added
    assert own["verdict"] == "nothing_missing" and own["missing"] == []
    tried = {row["effect"] for rows in own["candidates"] for row in rows}
    assert tried and not tried & set(added)
    assert own["base"]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    report = tmp_path / "report.html"
    further = json.loads(stimrig("improve", data, "--model", held, "--html", report, "--json"))
    assert [name.partition(":")[0] for name in further["structure"]] == added
    assert [step["added"] for step in further["steps"]] == [None] and further["verdict"] == "nothing_missing"
    assert further["steps"][0]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    assert "fatigue" in report.read_text().lower()


def test_fit_with_effects_gives_a_model_of_the_contract(tmp_path: Path) -> None:
    record = hidden_records.generate("output_saturation", "middle", seed=42, rate_hz=100, design="short")
    data = tmp_path / "record.csv"
    hidden_records.write_csv(record, data)
    model = json.loads(stimrig("fit", data, "--effects", "output_saturation", "--json"))
    assert [effect["id"] for effect in model["effects"]] == ["output_saturation"]
    assert {"linear", "recruitment", "valid_for", "uncertainty", "residual_tests", "data", "software"} <= set(model)
    assert {"b", "a", "delay_samples"} <= set(model["linear"])
    b, a = np.array(model["linear"]["b"]), np.array(model["linear"]["a"])
    assert b.sum() / a.sum() == pytest.approx(1.0, abs=1e-6)
