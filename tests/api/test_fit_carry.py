"""`stimrig fit NEW.csv --carry MODEL.json`: what the service says after a test, on the terminal and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import identify
from api.cli import main
from identify.records import parts_csv
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The model of a first session, and the record of a second one without the effect."""
    folder = tmp_path_factory.mktemp("carry")
    model, data = folder / "MODEL.json", folder / "second.csv"
    earlier = identify.fit(
        hidden_muscles.record("electromechanical_delay", seed=7), effects=["electromechanical_delay"]
    )
    model.write_text(earlier.to_json())
    parts_csv.write(hidden_muscles.record("", seed=8), data)
    return model, data


def test_words_and_json_say_what_is_no_longer_needed(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = files
    out = tmp_path / "new.json"
    assert main.run(["fit", str(data), "--carry", str(model), "-o", str(out)]) == 0
    words = capsys.readouterr().out
    assert "offered: the plain structure" in words and "no longer needed: electromechanical_delay." in words
    assert main.run(["fit", str(data), "--carry", str(model), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["effects"] == [] and found["extra"]["carried"]["no_longer_needed"] == ["electromechanical_delay"]
    assert json.loads(out.read_text())["extra"]["carried"]["offered"] == "plain"


def test_options_of_another_structure_are_one_line(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = files
    assert main.run(["fit", str(data), "--carry", str(model), "--effects", "fatigue"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "Leave out --method, --effects and --fit-on." in err
