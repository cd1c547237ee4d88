"""Comparison: errors split up, and correlation tests whose false alarms are what they say."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.muscles.physics_records import NOISE_SD_NM, record_of_physics
from stimrig import identify
from stimrig.identify.criticism import compare
from stimrig.identify.criticism.correlation import _bands, _filtered, _functions, _without_uncertainty
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.estimation.fit_statistics import UNDEFINED, best_fit_percent, ceiling_percent
from stimrig.identify.estimation.quality import quality
from tests.harness.carried_sessions import as_record
from tests.harness.patients import Patient, make_record
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


@pytest.mark.parametrize(("zero_nm", "said"), [(0.0, False), (0.3, True)])
def test_a_zero_that_wanders_in_another_record_is_named_beside_the_worst_places(zero_nm: float, said: bool):
    record = hidden_muscles.record(seed=3, rate_hz=100)
    other = record.with_torque(record.torque_nm + zero_nm * np.sin(0.17 * record.time_s))
    result = compare(identify.fit(record), other)
    assert (0.5 * zero_nm < result.wandering_zero_nm < zero_nm) == said
    assert all((("a zero that wanders" in words) == said) for words in (str(result), " ".join(result.plain)))


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


@pytest.mark.parametrize("share_fitted", [0.0, 0.6, 1.0])
def test_all_tests_together_alarm_on_five_percent_of_correct_models(share_fitted: float):
    """600 draws of noise and of an estimate's error: five percent to within 2.7 points (three standard errors)."""
    grid = make_grid(hidden_muscles.record(seed=14, rate_hz=100))
    known, fitted = grid.count > 0, np.arange(grid.size) < share_fitted * grid.size
    u = grid.pulse_width_us / grid.pulse_width_us.max()
    y = np.convolve(u, np.exp(-np.arange(60) / 8.0) / 8.0)[: grid.size]
    signals = {name: _filtered(signal, 0.0, known) for name, signal in {"u": u, "u2": u**2, "y": y}.items()}
    slopes = np.stack([np.ones(grid.size), u, u**2, y, y**2])
    rng = np.random.default_rng(99)
    # What one fit leaves uncertain: its own rows, or those of another record as long.
    own = slopes[:, fitted] if fitted.any() else slopes
    directions = np.linalg.inv(np.linalg.cholesky(own @ own.T)) @ slopes
    bands, alarms, draws = None, 0, 600
    for _ in range(draws):
        noise = rng.standard_normal(grid.size)
        estimate = directions[:, fitted] @ noise[fitted] if fitted.any() else rng.standard_normal(len(directions))
        residual, taken = _without_uncertainty(noise - estimate @ directions, directions, known, fitted)
        bands = bands or _bands(signals, known, taken)
        alarms += any(np.max(np.abs(values)) > bands[name] for name, values in _functions(residual, signals).items())
    assert 0.023 < alarms / draws < 0.077


def test_another_record_of_an_exact_muscle_looks_like_noise_and_one_of_a_stronger_muscle_does_not():
    made = record_of_physics("plain", 2027, disturbed=())
    model, other = identify.fit(as_record(made)), as_record(made["unseen"])
    noise_nm = np.random.default_rng(2027).normal(0.0, NOISE_SD_NM, other.time_s.size)
    alarms = [
        [test["words"] for test in compare(model, other.with_torque(torque_nm)).tests["tests"] if not test["passed"]]
        for torque_nm in (other.torque_nm + noise_nm, 1.1 * other.torque_nm + noise_nm)
    ]
    assert not alarms[0]
    assert alarms[1] and all("may" in words for words in alarms[1])


# ---- the verdict of quality -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def record() -> identify.Record:
    return make_record(Patient(), np.random.default_rng(2), rate_hz=100, noise_nm=0.05)[0]


@pytest.fixture(scope="module")
def model(record: identify.Record) -> identify.Model:
    return identify.fit(record)


@pytest.mark.parametrize("torque", [[], [0.3], [0.3] * 9, [0.1 + 0.2, 0.3] * 5, [1e6, 1e6 + 1e-6]])
def test_level_torque_has_no_best_fit(torque: list[float]) -> None:
    measured = np.array(torque)
    assert np.isnan(best_fit_percent(measured, measured + 1.0))
    assert np.isnan(ceiling_percent(measured, 0.1))


@pytest.mark.parametrize("effects", [(), ("fatigue",)])
def test_a_model_of_level_held_out_rows(record: identify.Record, effects: tuple[str, ...]) -> None:
    level = record.with_torque(np.where(record.held_out, 0.25, record.torque_nm))
    found = identify.fit(level, effects=effects)
    again = identify.Model.from_json(found.to_json())
    assert again.fit["held_out_fit_percent"] is None and again.fit["held_out_ceiling_percent"] is None
    assert found.quality["verdict"] == "not usable" and "whose torque is constant" in found.quality["words"]
    grid = make_grid(level)
    assert quality(again, grid, grid.fitted)["words"] == found.quality["words"]
    assert any(UNDEFINED in line for line in compare(again, level).plain)


@pytest.mark.parametrize(("error", "verdict"), [(0.055, "usable"), (0.15, "usable with care"), (0.5, "not usable")])
def test_an_error_on_level_rows_not_seen_counts(
    record: identify.Record, model: identify.Model, error: float, verdict: str
) -> None:
    level = {"held_out_fit_percent": None, "held_out_ceiling_percent": None, "held_out_rms_nm": error}
    assert judged(model, record, **level)["verdict"] == verdict


def judged(model: identify.Model, record: identify.Record, **fit: Any) -> dict[str, Any]:
    grid = make_grid(record)
    return quality(model.with_(fit=model.fit | fit), grid, grid.fitted)


@pytest.mark.parametrize(
    ("reached", "rms_nm", "verdict"),
    [
        (97.0, 0.051, "usable"),
        (95.0, 0.06, "usable with care"),
        (85.0, 0.06, "usable with care"),
        (85.0, 0.3, "not usable"),
        (-8.6e16, 3.0, "not usable"),
    ],
)
def test_the_gap_on_rows_not_seen_is_in_the_verdict(
    record: identify.Record, model: identify.Model, reached: float, rms_nm: float, verdict: str
) -> None:
    seen = {"held_out_fit_percent": reached, "held_out_ceiling_percent": 98.0, "held_out_rms_nm": rms_nm}
    found = judged(model, record, **seen)
    assert found["verdict"] == verdict
    assert ("held-out pulses" in found["words"]) == (rms_nm <= 0.3 or verdict == "not usable")


def test_a_residual_that_is_not_noise_asks_for_care_alone(record: identify.Record, model: identify.Model) -> None:
    assert model.quality["verdict"] == "usable" and model.quality["words"].endswith(" %.")
    grid = make_grid(record)
    alarmed = model.with_(residual_tests={"whiteness": {"passed": False}})
    found = quality(alarmed, grid, grid.fitted)
    assert found["verdict"] == "usable with care"
    assert (
        found["words"] == "Check this before use: the residual is not pure noise (whiteness test): see the diagnosis."
    )


@pytest.mark.parametrize("follows", [True, False])
def test_a_method_that_fails_is_blamed_where_the_torque_follows_the_pulses(record: identify.Record, follows: bool):
    noise_nm = np.random.default_rng(3).normal(0.0, 1.0, record.time_s.size)
    asked = record if follows else record.with_torque(noise_nm)
    found = identify.fit(asked, method="ramp-deconvolution", natural_frequency_rad_s=0.3).quality
    assert found["verdict"] == "not usable"
    blamed = "the torque follows the pulses" in found["words"] and "ramp-deconvolution fails" in found["words"]
    assert blamed == follows
    assert any("hardly" in reason for reason in found["reasons"]) != follows
