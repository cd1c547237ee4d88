"""The verbs on a table of two muscles at one joint."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from scipy.io import loadmat

from stimrig.api.cli import main
from tests.harness import two_muscles

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("two") / "two.csv"
    path.write_text(two_muscles.written(two_muscles.make(5, cross_talk=0.15)[0]))
    return path


def _run(capsys: Capture, *words: object) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main.run([str(word) for word in words])
    return code, *capsys.readouterr()


def test_a_model_of_two_muscles_is_fitted_compared_and_predicts(capsys: Capture, table: Path, tmp_path: Path) -> None:
    model, out = tmp_path / "two.json", tmp_path / "out.csv"
    code, _, said = _run(capsys, "fit", table, "--effects", "cross_talk:biceps>triceps", "-o", model)
    assert code == 0, said
    document = json.loads(model.read_text())
    assert document["kind"] == "joint"
    assert [one["name"] for one in document["channels"]] == ["biceps", "triceps"]
    compared = json.loads(_run(capsys, "compare", model, table, "--json")[1])
    assert compared["fit_percent"] > 95
    assert set(compared["alone"]) == {"biceps", "triceps"}
    assert _run(capsys, "predict", model, table, "-o", out)[0] == 0
    head, first = out.read_text().splitlines()[:2]
    assert head == "time_s,torque_nm,predicted_torque_nm,biceps_torque_nm,triceps_torque_nm"
    assert len(first.split(",")) == 5
    matlab = out.with_suffix(".mat")
    assert _run(capsys, "predict", model, table, "-o", matlab)[0] == 0
    assert set(head.split(",")) <= set(loadmat(matlab))


def test_cross_talk_is_named(capsys: Capture, table: Path) -> None:
    found = json.loads(_run(capsys, "diagnose", table, "--json")[1])
    assert [row["effect"] for row in found["missing"]] == ["cross_talk:biceps>triceps"]
    assert found["missing"][0]["name"] == "Cross-talk from biceps to triceps"
    assert found["conclusion"]["kind"] == "missing"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fit", "TABLE", "--effects", "fatigue"], "with several muscles give"),
        (["fit", "TABLE", "--method", "narx"], "--method is for records of one muscle"),
        (["fit", "TABLE", "--fit-on", "prbs"], "--fit-on is for records of one muscle"),
        (["fit", "TABLE", "-o", "OUT.mat"], "has no MAT file"),
        (["fit", "TABLE", "TABLE"], "not joined"),
        (["diagnose", "TABLE", "--html", "OUT.html"], "--html is for records of one muscle"),
        (["explain", "TABLE"], "no story yet"),
        (["fit", "TABLE", "--effects", "cross_talk:biceps>neck"], "no such channels"),
        (["compare", "TABLE", "TABLE"], "TABLE"),
    ],
)
def test_what_is_not_possible_is_said_in_one_line(
    words: list[str], said: str, capsys: Capture, table: Path, tmp_path: Path
) -> None:
    places = {"TABLE": str(table), "OUT.mat": str(tmp_path / "x.mat"), "OUT.html": str(tmp_path / "x.html")}
    code, out, error = _run(capsys, *[places.get(word, word) for word in words])
    assert code == 2
    assert out == ""
    assert places.get(said, said) in error
    assert error.count("\n") == 1, error
