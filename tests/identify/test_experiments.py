"""The next experiment: playable by the rig, and one that does separate the rivals."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig.identify.experiments import designs, next_experiment
from stimrig.identify.experiments.designs import SHAPES
from stimrig.rig.sequences import build
from tests.identify import hidden_muscles


@pytest.mark.parametrize("design", designs(300.0), ids=lambda d: d.name)
def test_the_rig_plays_what_was_simulated(design):
    for segment in design.segments:
        played = build(segment.sequence, segment.settings, 40.0)
        np.testing.assert_allclose(played, SHAPES[segment.sequence](segment.settings, 40.0))
        assert played.max() <= 300.0


def test_hysteresis_and_drift_are_told_apart_by_another_ramp():
    record = hidden_muscles.record("threshold_drift", seed=16, rate_hz=100)
    plan = next_experiment(record, ["threshold_drift", "recruitment_hysteresis"])
    assert plan["decides"] and "ramp" in plan["design"]
    assert plan["duration_s"] < 40.0 and plan["dose"]["pulses"] > 0
    assert max(s["settings"].get("max_pulse_width_us", 0.0) for s in plan["segments"]) <= 300.0
    sham = next(row for row in plan["alternatives"] if row["design"] == "sham")
    assert sham["expected_log_evidence"] < plan["expected_log_evidence"]
