"""What cannot be foreseen (hum, a zero that moves, efforts, tremor): explained in its own record, not predicted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.uncertainty import prediction_band
from stimrig.identify.inversion import Reference, invert
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import problem_of, unpredictable_torque
from tests.identify import hidden_muscles

EFFECTS = ("mains_hum", "baseline_drift", "voluntary_effort", "tremor")
HUM_NM = 0.3


@cache
def of_one_record(effect: str) -> tuple[identify.Record, Model, Model]:
    """A record with the effect, its plain model, and the one with the effect; read back from MODEL.json."""
    hum = effect == "mains_hum"
    record = hidden_muscles.record("" if hum else effect, seed=6, rate_hz=200 if hum else 100)
    if hum:
        hum_nm = HUM_NM * np.sin(2 * np.pi * 50.0 * record.time_s + 1.0)
        record = record.with_torque(record.torque_nm + hum_nm)
    plain, model = identify.fit(record), identify.fit(record, effects=[effect])
    return record, Model.from_json(plain.to_json()), Model.from_json(model.to_json())


@pytest.fixture(params=EFFECTS)
def case(request):
    return request.param, *of_one_record(request.param)


def test_another_record_is_predicted_as_without_the_effect(case):
    effect, record, plain, model = case
    mean_nm, rms_nm = unpredictable_torque(model)[effect]
    other = hidden_muscles.record(seed=7, noise_nm=0.0)
    without = model.with_(effects=(), baseline_nm=model.baseline_nm + mean_nm)
    np.testing.assert_allclose(model.predict(other), without.predict(other), atol=1e-9)
    # In its own fitted rows it is there, and takes off what it can be seen to have added.
    seen = ~record.held_out
    own = (record.torque_nm - model.predict(record))[seen]
    about_mean_nm = np.sqrt(rms_nm**2 - mean_nm**2)
    assert np.std(own) < 0.06 < about_mean_nm < 1.2 * np.std((record.torque_nm - plain.predict(record))[seen])
    assert abs(np.mean(model.predict(record)[seen] - record.torque_nm[seen])) < 0.02


def test_no_model_with_such_an_effect_predicts_worse_than_the_plain_one(case):
    _, _, plain, model = case
    other = hidden_muscles.record(seed=7, noise_nm=0.0)
    before, after = (np.sqrt(np.mean((one.predict(other) - other.torque_nm) ** 2)) for one in (plain, model))
    assert after < 1.02 * before + 0.004


def test_its_size_is_in_the_band_of_another_record_and_of_held_out_rows(case):
    effect, record, _, model = case
    rms_nm = unpredictable_torque(model)[effect][1]
    for one, rows in ((hidden_muscles.record(seed=7), slice(None)), (record, record.held_out)):
        lower, upper = prediction_band(model, one)
        half = 0.5 * (upper - lower)[rows]
        assert np.all(half >= 1.95 * rms_nm) and np.median(half) < 2.5 * rms_nm + 0.1
    lower, upper = prediction_band(model, record)
    assert np.median((upper - lower)[~record.held_out]) < 2.0 * rms_nm


def test_a_controller_s_model_knows_nothing_of_it(case):
    effect, _, _, model = case
    without = model.with_(effects=())
    reference = Reference(np.r_[np.zeros(20), np.full(60, 2.5), np.zeros(20)], 40.0)
    np.testing.assert_allclose(
        invert(model, reference).predicted_nm, invert(without, reference).predicted_nm, atol=0.02
    )
    problem, _ = problem_of(model, make_grid(hidden_muscles.record(seed=7)))
    assert effect not in [chosen.effect for chosen in problem.chosen]


def test_held_out_rows_are_judged_without_it_and_their_ceiling_knows_why(case):
    effect, record, plain, model = case
    held = record.held_out
    error = record.torque_nm - model.predict(record)
    assert model.fit["held_out_rms_nm"] == pytest.approx(np.sqrt(np.mean(error[held] ** 2)))
    if not find_effect(effect).sporadic:
        # Hum and drift go on where rows are held out: the error there hardly falls, and the ceiling says why.
        assert model.fit["held_out_rms_nm"] > 0.7 * plain.fit["held_out_rms_nm"]
        assert model.fit["held_out_ceiling_percent"] < plain.fit["held_out_ceiling_percent"] - 1.0
    assert model.fit["held_out_fit_percent"] > model.fit["held_out_ceiling_percent"] - 6.0
    assert model.quality["gates"]["gap"]["severity"] != "refuse" or model.quality["gates"]["gap"]["passed"]


def test_hum_is_printed_without_the_deviation_of_the_fits_prior():
    _, _, model = of_one_record("mains_hum")
    row = next(line for line in str(model).splitlines() if line.startswith("mains_hum"))
    assert "frequency_hz 50 Hz" in row and "±" not in row


def test_rows_left_out_in_turn_are_judged_without_it_too():
    record, _, _ = of_one_record("mains_hum")
    fitted = identify.fit(record.take(~record.held_out), effects=["mains_hum"]).fit
    assert fitted["held_out_by"] == "cross-validation"
    assert fitted["unforeseen_nm"] == pytest.approx(HUM_NM / np.sqrt(2), rel=0.05)
    assert fitted["held_out_rms_nm"] > 4 * fitted["rms_nm"]


@pytest.mark.parametrize("held_out_gain", [1.0, 0.8])
def test_tremor_counts_on_held_out_rows_as_it_is_there_and_an_error_of_the_structure_does_not(held_out_gain: float):
    record = hidden_muscles.record(seed=6, rate_hz=100)
    phase = 2 * np.pi * 5.0 * record.time_s + np.cumsum(np.random.default_rng(6).normal(0.0, 0.08, record.time_s.size))
    gain, wave_nm = np.where(record.held_out, held_out_gain, 1.0), 0.4 * np.sin(phase)
    model = identify.fit(record.with_torque(gain * record.torque_nm + wave_nm), effects=["tremor"])
    assert model.fit["unforeseen_nm"] == pytest.approx(0.4 / np.sqrt(2), rel=0.07)
    assert (model.quality["verdict"] == "not usable") == (held_out_gain < 1.0)


def test_an_effort_on_held_out_rows_is_taken_to_be_of_its_usual_size():
    _, _, model = of_one_record("voluntary_effort")
    beside_noise_nm = np.sqrt(model.fit["held_out_rms_nm"] ** 2 - model.fit["noise_sd_nm"] ** 2)
    usual_nm = unpredictable_torque(model)["voluntary_effort"][1]
    assert model.fit["unforeseen_nm"] == pytest.approx(min(usual_nm, beside_noise_nm))
