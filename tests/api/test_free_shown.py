"""Free effects in a model: the picture with its band, the sentence, and no second offer."""

from __future__ import annotations

import json
from pathlib import Path

from stimrig.api.charts.drawing import Figures
from stimrig.api.charts.model_charts import free_effects
from stimrig.api.models import explanation
from stimrig.api.web.pages.environment import environment
from tests.api.test_own_effect_export import with_gate

LINES = {"opening": {"value": [0.0, 1.0], "lower": [0.0, 0.9], "upper": [0.0, 1.1]}}
SHAPE = {
    "enters": "rate of fall", "driven_by": "time since", "words": "Pulses open a gate.", "driver": "time (s)",
    "effect": "opening (1)", "at": [0.0, 0.5], "lines": LINES,
}  # fmt: skip


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
