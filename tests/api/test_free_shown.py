"""Free effects on the page, in reports and notebooks: the picture with its band, the sentence, what a model holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stimrig import identify
from stimrig.api.charts import diagnosis_charts
from stimrig.api.charts.drawing import Figures
from stimrig.api.charts.interactive import plotly_figure
from stimrig.api.charts.plot import plot
from stimrig.api.models import explanation
from stimrig.api.web.pages.environment import environment
from stimrig.identify.errors import BadRequest
from tests.api.test_own_effect_export import with_gate

LINES = {
    name: {"value": [0.0, one], "lower": [0.0, 0.9 * one], "upper": [0.0, 1.1 * one]}
    for name, one in (("opening", 1.0), ("speed", 0.5))
}
SHAPE = {
    "enters": "rate of fall", "driven_by": "time since", "words": "Pulses open a gate.", "driver": "time (s)",
    "effect": "opening <a href='x'>", "at": [0.0, 0.5], "lines": LINES,
}  # fmt: skip


def diagnosis() -> dict[str, Any]:
    row = {
        "effect": "free_gate", "name": "A gate that pulses open", "form": "two_lags", "equation": "w = γ f(u)",
        "parameters": {"gate_s": {"value": 0.02, "sd": 0.001, "unit": "s"}}, "left_out": "It falls by 78 %.",
    }  # fmt: skip
    return {
        "verdict": "unexplained_structure", "missing": [], "structure": [], "experiment": None, "noise_sd_nm": 0.05,
        "free": [row | {"axis" if key == "effect" else key: value for key, value in SHAPE.items()}],
    }  # fmt: skip


def test_a_picture_has_each_curve_with_its_band_and_axes_that_are_no_links() -> None:
    view = explanation.view(diagnosis(), None)
    drawn = diagnosis_charts.diagnosis_figures(None, [], view, {}, [])["free-free_gate"]
    assert [curve.y for curve in drawn.curves if curve.label in LINES] == [[0.0, 1.0], [0.0, 0.5]]
    assert [band.lower for band in drawn.bands] == [curve["lower"] for curve in LINES.values()]
    layout = plotly_figure(drawn)["layout"]
    assert layout["xaxis"]["title"]["text"] == "time (s)" and "<" not in layout["yaxis"]["title"]["text"]


def test_a_model_that_holds_it_shows_it_and_the_diagnosis_does_not_offer_it_again(tmp_path: Path) -> None:
    document = json.loads(with_gate(tmp_path / "MODEL.json", shape=SHAPE).read_text("utf-8"))
    (card,) = explanation.held_free(document)
    assert card["words"] == "Pulses open a gate." and card["axis"] == SHAPE["effect"]
    assert list(diagnosis_charts.free_effects([card])) == ["free-free_gate"]
    drawn = Figures(diagnosis_charts.free_effects([card]))
    shown = environment.get_template("model_parts.html").module.free(card, drawn)  # pyright: ignore[reportAttributeAccessIssue]
    assert "Pulses open a gate." in shown and 'data-figure="free-free_gate"' in shown
    assert explanation.remaining(diagnosis(), ["free_gate"], {})["free"] == []
    assert explanation.held_free({"effects": [{"id": "fatigue"}]}) == []


def test_a_notebook_draws_what_a_diagnosis_found_freely() -> None:
    found = object.__new__(identify.Diagnosis)
    found.__dict__["free"] = tuple(diagnosis()["free"])
    assert [trace.name for trace in plot(found).data if trace.name in LINES] == list(LINES)
    found.__dict__["free"] = ()
    with pytest.raises(BadRequest, match="free effect"):
        plot(found)
