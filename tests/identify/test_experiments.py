"""The next experiment: playable by the rig, and one that does separate the rivals."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig.identify.estimation.effect_fit import fitted_with
from stimrig.identify.experiments import expected_log_evidence, plan
from stimrig.identify.experiments.designs import SHAPES, designs
from stimrig.rig.sequences import build
from tests.identify import hidden_muscles


@pytest.mark.parametrize("design", designs(300.0), ids=lambda d: d.words)
def test_the_rig_plays_what_was_simulated(design):
    for segment in design.segments:
        played = build(segment.sequence, segment.settings, 40.0)
        np.testing.assert_allclose(played, SHAPES[segment.sequence](segment.settings, 40.0))
        assert played.max() <= 300.0


def test_hysteresis_and_drift_are_told_apart_by_another_ramp():
    record = hidden_muscles.record("threshold_drift", seed=16, rate_hz=100)
    fits = {name: fitted_with(record, [name]) for name in ("threshold_drift", "recruitment_hysteresis")}
    found = plan(record, fits)
    assert found.decides and "ramp" in found.text
    assert found.duration_s < 40.0 and found.dose["pulses"] > 0
    assert max(s["settings"].get("max_pulse_width_us", 0.0) for s in found.segments) <= 300.0
    sham = next(design for design in designs(300.0) if design.words == "A test without stimulation").pulse_widths(40.0)
    assert expected_log_evidence(sham, record, fits) < found.expected_log_evidence
