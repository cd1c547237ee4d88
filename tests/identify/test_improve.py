"""Improving: the error falls step by step, each step a model with its forebear; what isn't there is refused."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.estimation.uncertainty import prediction_band
from stimrig.identify.model import Model
from tests.harness import few_effects
from tests.identify import hidden_muscles
from tests.identify.dear import fatigued, improved_with_a_delay

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def improved():
    return fatigued(), improved_with_a_delay()


def test_the_error_falls_towards_the_noise(improved):
    _, result = improved
    assert result.steps[0]["added"] is None and result.steps[1]["added"] == "fatigue"
    before, after = result.steps[0], result.steps[1]
    assert after["held_out_rms_nm"] < 0.6 * before["held_out_rms_nm"]
    assert after["rms_nm"] < 1.1 * result.noise_sd_nm


def test_each_step_is_a_model_that_predicts_what_the_step_says(improved):
    record, result = improved
    for step, made in zip(result.steps, result.models, strict=True):
        model = Model.from_json(made.to_json())
        error = (record.torque_nm - model.predict(record))[record.held_out]
        assert abs(np.sqrt(np.mean(error**2)) - step["held_out_rms_nm"]) < 1e-6
        assert model.model_id == step["model_id"]
    parents = [model.extra["parent"] for model in result.models]
    assert parents == [None, *[model.model_id for model in result.models[:-1]]]


def test_what_is_not_there_is_refused_with_a_reason_and_can_be_forced(improved):
    _, result = improved
    assert result.steps[-1]["added"] == "electromechanical_delay"
    assert "on request" in result.steps[-1]["reason"]
    refusals = {row["effect"]: row["reason"] for row in result.refused}
    assert "log evidence" in refusals["electromechanical_delay"]


def held(record: identify.Record, lower: np.ndarray, upper: np.ndarray) -> float:
    """Share of the samples within a band."""
    return float(np.mean((lower <= record.torque_nm) & (record.torque_nm <= upper)))


def test_a_model_with_effects_carries_bands_and_a_verdict():
    """The band holds the muscle's own torque, and without the effect it is far wider; it grows with the noise at most.

    The verdict's gates are those of any model.
    """
    widths, clean = [], hidden_muscles.record("fatigue", seed=5, noise_nm=0.0)
    for noise_nm in (0.03, 0.06):
        record = hidden_muscles.record("fatigue", seed=5, noise_nm=noise_nm)
        with few_effects.only("fatigue", "output_saturation"):
            base, model = (Model.from_json(each.to_json()) for each in identify.improve(record).models)
        assert [effect["id"] for effect in model.effects] == ["fatigue"]
        assert model.quality["verdict"] in ("usable", "usable with care")
        assert model.valid_for["pulse_rate_hz"] == [38.0, 42.0]
        lower, upper = prediction_band(model, record)
        assert held(clean, lower, upper) > 0.8
        base_lower, base_upper = prediction_band(base, record)
        assert held(clean, base_lower, base_upper) > 0.7
        assert np.mean(base_upper - base_lower) > 3.0 * np.mean(upper - lower)
        curve = {key: np.asarray(values) for key, values in model.bands["recruitment"].items()}
        true_nm = hidden_muscles.recruited(curve["pulse_width_us"])
        assert np.mean((curve["whole_lower"] <= true_nm) & (true_nm <= curve["whole_upper"])) > 0.85
        assert np.max(np.abs(curve["value"] - true_nm)) < 0.15
        assert np.max(np.abs(np.asarray(base.bands["recruitment"]["value"]) - true_nm)) > 0.5
        widths.append(float(np.mean((upper - lower)[~record.held_out])))
        assert widths[-1] < noise_nm  # the whole band: some two hundred samples a parameter
    # What an inexact form leaves is in the band, too, where the noise does not hide it: it is, in the quieter record.
    assert 0.5 < widths[1] / widths[0] < 2.8


def test_every_step_keeps_what_the_structure_held():
    record = hidden_muscles.record("fatigue", seed=15)
    record = record.with_torque(record.torque_nm + 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s))
    with few_effects.only("baseline_drift", "fatigue", "mains_hum", "tremor"):
        held = identify.fit(record, effects=["baseline_drift:linear"])
        result = identify.improve(record, model=held)
        last = identify.diagnose(record, result.models[-1])
    assert last.verdict == "nothing_missing", "where no effect is left to try, that is no error"
    assert [step["added"] for step in result.steps] == [None, "mains_hum", "fatigue"]
    for model in result.models:
        assert model.effects[0]["id"] == "baseline_drift"


@pytest.mark.parametrize(
    "hidden",
    ["threshold_drift", *(pytest.param(n, marks=pytest.mark.campaign) for n in ("fatigue", "asymmetric_relaxation"))],
)
def test_what_improving_ends_with_lacks_nothing(hidden):
    record = hidden_muscles.record(hidden, seed=11, rate_hz=100)
    with few_effects.only("asymmetric_relaxation", "fatigue", "recruitment_hysteresis", "threshold_drift"):
        model = identify.improve(record).models[-1]
        assert [effect["id"] for effect in model.effects] == [hidden]
        assert identify.diagnose(record, model).verdict == "nothing_missing"
