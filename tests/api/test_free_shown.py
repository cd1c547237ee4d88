"""Free effects in a model: the picture with its band, the sentence, and no second offer."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.api.charts.drawing import Figures
from stimrig.api.charts.model_charts import free_effects
from stimrig.api.models import explanation
from stimrig.api.web.pages.environment import environment
from tests.harness.carried_sessions import as_record

LINES = {"opening": {"value": [0.0, 1.0], "lower": [0.0, 0.9], "upper": [0.0, 1.1]}}
SHAPE = {
    "enters": "rate of fall", "driven_by": "time since", "words": "Pulses open a gate.", "driver": "time (s)",
    "effect": "opening (1)", "at": [0.0, 0.5], "lines": LINES,
}  # fmt: skip


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


def test_a_model_that_holds_it_shows_it_and_the_diagnosis_does_not_offer_it_again(tmp_path: Path) -> None:
    document = json.loads(with_gate(tmp_path / "MODEL.json", shape=SHAPE).read_text("utf-8"))
    (card,) = explanation.held_free(document)
    assert card["words"] == "Pulses open a gate." and card["axis"] == SHAPE["effect"]
    drawn = Figures(free_effects([card]))
    shown = environment.get_template("model_parts.html").module.effect(card, drawn)
    assert "Pulses open a gate." in shown and 'data-figure="free-free_gate"' in shown
    row = {"effect": "free_gate", "name": "A gate", "form": "two_lags", "equation": "w = γ f(u)", "parameters": {}}
    diagnosis = {"verdict": "unexplained_structure", "missing": [], "structure": [], "experiment": None, "free": [row]}
    assert explanation.remaining(diagnosis, ["free_gate"], {})["free"] == []
    assert explanation.held_free({"effects": [{"id": "fatigue"}]}) == []
