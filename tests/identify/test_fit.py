"""The default method: certified constants, metamorphic relations, noise, ceilings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify import paper
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.fit_statistics import BLOCK_S, FOLDS, best_fit_percent, held_out_change
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.estimation.solve import solve
from stimrig.identify.noise import SLOWEST_S
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment.bases import SplineBasis
from stimrig.identify.recruitment.smoothing import choose_weight, spline_roughness
from tests.harness.patients import Patient, make_record
from tests.identify import hidden_muscles

NOISY = 0.05


def fitted(record: Record, **options) -> tuple[identify.Model, np.ndarray]:
    model = identify.fit(record, **options)
    return model, identify.predict(model, record)


def rows(record: Record, name: str) -> np.ndarray:
    return np.array(record.segment_names)[record.segment] == name


@pytest.mark.parametrize("rate_hz", [40, 1000])
def test_recovers_the_papers_muscle_without_noise(rate_hz):
    record, clean = make_record(Patient(), np.random.default_rng(11), rate_hz=rate_hz, noise_nm=0.0)
    model, predicted = fitted(record)
    assert isinstance(model.linear, SecondOrder)
    assert model.linear.time_constant_s == pytest.approx(0.5284, rel=1e-4)
    assert model.linear.damping == pytest.approx(0.6369, rel=1e-4)
    assert model.linear.delay_s == pytest.approx(0.0, abs=2e-5)
    width = np.linspace(0, 300, 61)
    assert np.max(np.abs(model.recruitment(width) - Patient().recruitment(width))) < 0.01
    assert best_fit_percent(clean[rows(record, "ramp")], predicted[rows(record, "ramp")]) >= 99.98
    assert best_fit_percent(clean[rows(record, "validate")], predicted[rows(record, "validate")]) >= 99.9


@pytest.mark.parametrize(("delay_s", "rate_hz"), [(0.02, 40), (0.0004, 1600)])
def test_recovers_timing_within_a_sample(delay_s, rate_hz):
    patient = Patient(delay_s=delay_s, time_constant_s=0.2)
    record, _ = make_record(patient, np.random.default_rng(5), rate_hz=rate_hz, noise_nm=0.0)
    assert identify.fit(record).linear.delay_s == pytest.approx(delay_s, abs=2e-4)


def test_a_longer_delay_is_an_effect():
    """The plain structure cannot hold it, so that it is seen to fail; with the effect it is found to a millisecond."""
    patient = Patient(delay_s=0.06, time_constant_s=0.2)
    record, _ = make_record(patient, np.random.default_rng(5), rate_hz=400, noise_nm=NOISY)
    plain_model = identify.fit(record)
    assert abs(plain_model.linear.delay_s) <= 1.02 / 400 + 1e-9
    model = identify.fit(record, effects=["electromechanical_delay:delay"])
    delay_s = model.linear.delay_s + model.effects[0]["parameters"]["delay_s"]["value"]
    assert delay_s == pytest.approx(0.06, abs=1e-3)
    assert model.fit["held_out_rms_nm"] < 1.05 * NOISY < plain_model.fit["held_out_rms_nm"]


def test_held_out_rows_are_never_used():
    record, _ = make_record(Patient(), np.random.default_rng(7), noise_nm=NOISY)
    spoiled = record.with_torque(np.where(record.held_out, -50.0, record.torque_nm))
    model, other = identify.fit(record), identify.fit(spoiled)
    assert other.linear == model.linear
    assert np.array_equal(other.recruitment.coefficients_nm, model.recruitment.coefficients_nm)
    assert other.noise == model.noise
    assert other.fit["held_out_rms_nm"] > 10 * model.fit["held_out_rms_nm"]


def test_without_validate_the_held_out_error_is_cross_validated():
    record, _ = make_record(Patient(), np.random.default_rng(8), noise_nm=NOISY, validate=False)
    model = identify.fit(record)
    assert model.fit["held_out_by"] == "cross-validation"
    assert model.fit["held_out_rms_nm"] >= model.fit["rms_nm"]
    assert model.fit["held_out_rms_nm"] < 1.2 * NOISY


@pytest.mark.parametrize("ar1", [0.0, 0.9])
def test_cross_validation_agrees_with_refits_of_the_same_design(ar1: float):
    record, _ = make_record(Patient(), np.random.default_rng(9), rate_hz=40, noise_nm=0.2, ar1=ar1, validate=False)
    grid, _ = prepare(record)
    fitted_all = fit_plain(grid, grid.fitted)
    setup = fitted_all.problem.setup
    fold = (np.cumsum(grid.fitted) // round(BLOCK_S * 40)) % FOLDS
    change = held_out_change(fitted_all)
    for number in range(1, FOLDS):  # without the first seconds the state at the begin would be open, too
        out = grid.fitted & (fold == number)
        part = Problem(setup.with_(fitted=grid.fitted & ~out), [])
        again = solve(part, fitted_all.theta, fitted_all.noise, tolerance=1e-6)
        honest = (fitted_all.residual_nm - again.residual_nm)[out]
        assert np.linalg.norm(change[out] - honest) < 0.15 * np.linalg.norm(honest)


def test_a_record_with_a_single_fold_has_no_held_out_error():
    """Left out it would leave nothing to fit: the error of the fit itself was given as that of left-out parts."""
    record, _ = make_record(Patient(), np.random.default_rng(9), rate_hz=40, noise_nm=0.05, validate=False)
    short = fitted(record.take((record.time_s > 0.9) & (record.time_s < 2.8)))[0]
    assert short.fit["held_out_by"] == "none" and short.fit["held_out_rms_nm"] is None


@pytest.mark.parametrize("pulse_rate_hz", [20.0, 40.0])
def test_the_slowest_noise_has_the_same_memory_at_each_pulse_rate(pulse_rate_hz: float):
    """A zero that drifts is slower than any noise may be."""
    grid, _ = prepare(replace(hidden_muscles.record("baseline_drift"), pulse_rate_hz=pulse_rate_hz))
    noise = fit_plain(grid, grid.fitted).noise
    assert noise.at_bound and noise.ar1 == pytest.approx(1.0 - 1.0 / (SLOWEST_S * pulse_rate_hz), abs=1e-6)


def test_effects_leave_no_warning_of_the_plain_fit():
    """A line takes what the plain fit has to take for the slowest noise there is."""
    record = hidden_muscles.record("baseline_drift")
    warning = "The slow noise is as slow as it may be"
    assert any(warning in reason for reason in identify.fit(record).reasons), "else nothing is tried"
    model = identify.fit(record, effects=["baseline_drift:linear"])
    assert model.noise.ar1 == 0.0 and not any(warning in reason for reason in model.reasons)


@pytest.mark.parametrize("noise_nm", [0.02, 0.1])
@pytest.mark.parametrize("rate_hz", [40, 1600])
def test_fit_reaches_its_ceiling_and_the_noise_is_estimated(noise_nm, rate_hz):
    record, _ = make_record(Patient(), np.random.default_rng(300), rate_hz=rate_hz, noise_nm=noise_nm)
    model = identify.fit(record)
    assert model.fit["fit_percent"] >= model.fit["ceiling_percent"] - 0.1
    assert model.noise.white_sd_nm == pytest.approx(noise_nm, rel=0.08)


@pytest.mark.parametrize("ar1", [0.0, 0.7])
def test_white_and_correlated_noise_are_told_apart(ar1: float):
    """Correlated from sample to sample of 40 a second."""
    record, _ = make_record(Patient(), np.random.default_rng(40), rate_hz=40, noise_nm=NOISY, ar1=ar1, validate=False)
    assert identify.fit(record).noise.ar1 == pytest.approx(ar1, abs=0.15 * (ar1 > 0.0))


@pytest.mark.parametrize("rise_us", [5, 25])
def test_steep_recruitment_leaves_no_structure(rise_us):
    steep = 4.4 / rise_us
    patient = Patient(a2=steep, a3=float(np.exp(min(steep * 150, 600))), time_constant_s=0.3)
    record, clean = make_record(patient, np.random.default_rng(60), noise_nm=NOISY)
    model, predicted = fitted(record)
    assert best_fit_percent(clean[~record.held_out], predicted[~record.held_out]) > 99.5
    assert model.noise.ar1 == 0.0


def test_fit_on_names_the_segments():
    record, _ = make_record(Patient(), np.random.default_rng(14), noise_nm=0.0)
    model = identify.fit(record, fit_on=("ramp",))
    assert model.fit["samples"] < (~record.held_out).sum()
    with pytest.raises(identify.BadRequest, match="no segment 'sprint'"):
        identify.fit(record, fit_on=("sprint",))
    with pytest.raises(identify.BadRequest, match="never fitted"):
        identify.fit(record, fit_on=("validate",))


def test_an_effect_that_is_asked_for_is_fitted_to_its_end() -> None:
    """From a delay of 20 ms, of which the record has 3, a search was given up: the fit fell by 5 points."""
    rng = np.random.default_rng(720149)
    patient = Patient.draw(rng)
    rng.choice(5), rng.choice(3)  # rate and noise, as they were drawn where this was seen
    baseline_nm = float(rng.uniform(-1, 1))
    record, _ = make_record(patient, rng, noise_nm=0.1, baseline_nm=baseline_nm, pulses=paper.protocol())
    plain = identify.fit(record)
    delayed = identify.fit(record, effects=["electromechanical_delay:delay"])
    assert delayed.fit["fit_percent"] > plain.fit["fit_percent"] - 0.1


@pytest.mark.parametrize("seed", range(6))
def test_rounding_of_the_penalty_does_not_choose_the_smoothness(seed: int) -> None:
    """Of knots 0.015 to 15 µs apart rounding leaves the penalty a negative eigenvalue: the variance was 3e-11."""
    rng = np.random.default_rng(seed)
    basis = SplineBasis(np.unique(np.r_[np.linspace(0.0, 300.0, 20), 150.0 + np.linspace(0.0, 0.1, 8)[1:]]))
    design = 100.0 * basis.design(rng.uniform(0.0, 300.0, 500))
    straight = np.linspace(0.0, 1.0, 400)
    line = np.linalg.lstsq(basis.design(300.0 * straight), straight, rcond=None)[0]
    torque = design @ line + rng.standard_normal(500)
    choice = choose_weight(design.T @ design, design.T @ torque, float(torque @ torque), 500, spline_roughness(basis))
    assert choice.variance == pytest.approx(1.0, rel=0.2)
