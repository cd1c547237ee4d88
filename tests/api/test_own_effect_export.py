"""`stimrig effects --export`: a free effect as a file of one's own; bad input costs one line."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest

from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.api.cli import main
from stimrig.identify.effects import own_file
from tests.harness.carried_sessions import as_record


@cache
def plain() -> str:
    return identify.fit(as_record(record_of_physics("plain", 0))).to_json()


def with_gate(path: Path, **changes: object) -> Path:
    """A model's file with a free gate in it."""
    shape = dict.fromkeys(("enters", "driven_by", "words", "driver", "effect"), "x") | {"at": [], "lines": {}}
    numbers = {"gate_s": (0.02, 0.001), "bend": (3.0, 0.1), "gate_rate": (-0.5, 0.01)}
    gate = {
        "id": "free_gate",
        "form": "two_lags",
        "parameters": {one: {"value": value, "sd": sd, "unit": "1"} for one, (value, sd) in numbers.items()},
        "settings": {"scale_nm": 5.0, "noise_sd_nm": 0.05, "zero_nm": 0.0, "sign": 1.0},
        "shape": shape,
    }
    document = json.loads(plain())
    path.write_text(json.dumps(document | {"effects": [gate | changes]}), "utf-8")
    return path


def test_what_was_found_becomes_a_file_that_loads(tmp_path: Path) -> None:
    model, target = with_gate(tmp_path / "MODEL.json"), tmp_path / "mine.py"
    words = ["effects", "--export", str(model), "--name", "mine", "-o", str(target)]
    assert main.run(words) == 0
    (form,) = own_file.effect_of(target).forms
    assert [p.start[0] for p in form.parameters] == [0.02, 3.0, -0.5]
    target.write_text("mine", "utf-8")
    assert main.run(words) == 2 and target.read_text("utf-8") == "mine", "a file that is there is kept"


@pytest.mark.parametrize(
    ("changes", "asked", "said"),
    [
        ({}, ["--effect", "free_ways"], "no free effect 'free_ways' in it. It has free_gate"),
        ({}, ["--name", "Not a name"], "no name for an effect"),
        ({}, ["--name", "fatigue"], "an effect is called so already"),
        ({"parameters": {"gate_s": 0.02, "bend": 3.0, "gate_rate": -0.5}}, [], "gate_s"),
        ({"id": "nobody_knows"}, [], "no free effect"),
    ],
)
def test_bad_input_costs_one_line(
    tmp_path: Path, changes: dict, asked: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model = with_gate(tmp_path / "MODEL.json", **changes)
    assert main.run(["effects", "--export", str(model), "-o", str(tmp_path / "mine.py"), *asked]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1 and not (tmp_path / "mine.py").exists()
