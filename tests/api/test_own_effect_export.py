"""`stimrig effects --export`: a free effect as a file of one's own; bad input costs one line."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest

from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.api.cli.commands.effects import effects
from stimrig.api.cli.errors import InputError
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


def test_what_was_found_becomes_a_file_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mine.py"
    effects(export=with_gate(tmp_path / "MODEL.json"), name="mine", output=target)
    assert str(target) in capsys.readouterr().out
    (form,) = own_file.effect_of(target).forms
    assert [p.start[0] for p in form.parameters] == [0.02, 3.0, -0.5]


def test_a_file_that_is_there_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "mine.py"
    target.write_text("mine", "utf-8")
    with pytest.raises(InputError, match=r"mine\.py: File exists"):
        effects(export=with_gate(tmp_path / "MODEL.json"), name="mine", output=target)
    assert target.read_text("utf-8") == "mine"


@pytest.mark.parametrize(
    ("changes", "asked", "said"),
    [
        ({}, {"effect": "free_ways"}, "no free effect 'free_ways' in it. It has free_gate"),
        ({}, {"name": "Not a name"}, "no name for an effect"),
        ({}, {"name": "fatigue"}, "an effect is called so already"),
        ({"parameters": {"gate_s": 0.02, "bend": 3.0, "gate_rate": -0.5}}, {}, "gate_s"),
        ({"id": "nobody_knows"}, {}, "no free effect"),
    ],
)
def test_bad_input_costs_one_line(tmp_path: Path, changes: dict, asked: dict, said: str) -> None:
    given = {"name": "mine", "output": tmp_path / "mine.py"} | asked
    with pytest.raises(InputError) as told:
        effects(export=with_gate(tmp_path / "MODEL.json", **changes), **given)
    assert said in str(told.value) and "\n" not in str(told.value)
