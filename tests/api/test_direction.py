"""A cell mounted the other way round: a told torque is the record's own, or it says that it is the muscle's."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig import identify
from stimrig.api.cli.commands.diagnose import effect_lines
from stimrig.api.models import explanation, stored_model
from stimrig.api.web.pages.environment import environment
from tests.harness import few_effects
from tests.identify import hidden_muscles

PULLS = "as the muscle pulls"


def drifting(sign: int) -> identify.Record:
    """Downward by 0.03 N·m/s where the cell is inverted, from a baseline on the same side."""
    record = hidden_muscles.record("baseline_drift", seed=5)
    return record.with_torque(sign * (record.torque_nm + 0.5))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_torque_told_of_an_effect_says_when_it_counts_as_the_muscle_pulls(sign: int) -> None:
    model = identify.fit(drifting(sign), effects=["baseline_drift:linear"])
    slope = model.effects[0]["parameters"]["slope_nm_per_s"]
    assert slope["value"] == pytest.approx(0.03, abs=0.01)
    assert np.sign(model.baseline_nm) == sign
    assert slope.get("direction") == (None if sign > 0 else PULLS)
    assert (f"N·m/s {PULLS}" in str(model)) == (sign < 0)


def test_numbers_without_a_direction_and_those_of_the_sensor_say_nothing() -> None:
    model = identify.fit(drifting(-1), effects=["fatigue"])
    assert not any("direction" in p for p in model.effects[0]["parameters"].values())
    record = drifting(-1)
    hum_nm = 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s)
    hum = identify.fit(record.with_torque(record.torque_nm + hum_nm), effects=["mains_hum"]).effects[0]["parameters"]
    assert hum["sin_1_nm"]["value"] == pytest.approx(0.3, abs=0.02)
    assert "direction" not in hum["sin_1_nm"]


@pytest.mark.slow
def test_the_diagnosis_tells_it_too_in_a_terminal_and_on_the_page() -> None:
    with few_effects.only("baseline_drift", "fatigue"):
        missing, upright = (identify.diagnose(drifting(sign)).missing for sign in (-1, 1))
    entry = next(entry for entry in missing if entry["effect"] == "baseline_drift")
    assert any(line.endswith(PULLS) for line in effect_lines(entry))
    effect = environment.get_template("why.html").make_module().effect  # type: ignore[attr-defined]
    assert PULLS in effect(explanation.card(entry, {}), 1, {})
    assert PULLS not in effect(explanation.card(upright[0], {}), 1, {})


def test_threshold_plateau_and_validity_are_those_of_the_same_cell_mounted_upright() -> None:
    record = hidden_muscles.record("fatigue", seed=5)
    upright, inverted = (identify.fit(record.with_torque(12 + sign * record.torque_nm)).to_dict() for sign in (1, -1))
    one, other = stored_model.recruitment(upright), stored_model.recruitment(inverted)
    assert one["threshold_us"] == pytest.approx(other["threshold_us"], abs=1)
    assert one["saturation_us"] == pytest.approx(other["saturation_us"], abs=1)
    assert one["plateau_nm"] is not None and one["plateau_nm"] > 1
    assert other["plateau_nm"] == pytest.approx(-one["plateau_nm"], rel=0.01)
    assert "torques up to" in str(stored_model.validity(upright)) and "torques down to -" in str(
        stored_model.validity(inverted)
    )
