"""Comparison: errors split up, and correlation tests whose false alarms are what they say."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.criticism import compare
from stimrig.identify.criticism.correlation import _auto, _bands, _cross, _filtered
from stimrig.identify.dynamics.grid import make_grid
from tests.identify import hidden_muscles


@pytest.fixture(scope="module")
def compared():
    record = hidden_muscles.record("fatigue", seed=12)
    return record, compare(identify.fit(record), record)


def test_the_tables_add_up_series_fit_a_screen_and_words_name_a_place(compared):
    record, result = compared
    for kind in ("segment", "level", "direction", "time"):
        rows = result.by[kind]
        assert sum(row["samples"] for row in rows) == record.time_s.size
        assert abs(sum(row["share_of_excess"] for row in rows) - 1.0) < 1e-9
    power = sum(row["rms_nm"] ** 2 for row in result.by["frequency"])
    assert abs(np.sqrt(power) - result.rms_nm) < 0.02 * result.rms_nm + 1e-3
    assert len(result.series["time_s"]) <= 2400
    assert result.fit_percent < result.ceiling_percent
    assert any("N·m" in place["text"] and "%" in place["text"] for place in result.where)
    json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize("others", [0, 30])
def test_a_record_that_is_nearly_all_held_out_is_compared_as_a_whole(others: int):
    record = hidden_muscles.record(seed=3)
    model = identify.fit(record)
    segment = (np.arange(record.time_s.size) < others).astype(record.segment.dtype)
    held = compare(model, replace(record, segment=segment, segment_names=("validate", "rest")))
    own = compare(model, record)
    assert held.rms_nm == pytest.approx(own.rms_nm, rel=0.05) and held.held_out is None
    assert held.fitted["samples"] == record.time_s.size and "validate" not in held.where[0]["text"]


def test_a_wrong_model_alarms_and_a_right_one_does_not(compared):
    _, result = compared
    assert not all(test["passed"] for test in result.tests["tests"])
    record = hidden_muscles.record(seed=13)
    alarms = [test["with"] for test in compare(identify.fit(record), record).tests["tests"] if not test["passed"]]
    assert len(alarms) <= 1


def test_false_alarms_on_perfect_residuals_are_four_to_six_percent():
    """4000 draws of perfect noise: five percent to within 1.1 points (three standard errors)."""
    grid = make_grid(hidden_muscles.record(seed=14, rate_hz=100))
    known = grid.count > 0
    signals = {
        "u": grid.pulse_width_us,
        "u2": grid.pulse_width_us**2,
        "y": np.convolve(grid.pulse_width_us, np.exp(-np.arange(60) / 8.0) / 8.0)[: grid.size],
    }
    signals = {name: _filtered(signal, 0.0, known) for name, signal in signals.items()}
    bands = _bands(signals, known)
    rng = np.random.default_rng(99)
    draws = 4000
    alarms = dict.fromkeys(bands, 0)
    for _ in range(draws):
        noise = rng.standard_normal(grid.size)
        noise -= noise.mean()
        alarms["residual"] += np.max(np.abs(_auto(noise))) > bands["residual"]
        for name, signal in signals.items():
            alarms[name] += np.max(np.abs(_cross(noise, signal))) > bands[name]
    for name, count in alarms.items():
        assert 0.039 < count / draws < 0.061, (name, count / draws)
