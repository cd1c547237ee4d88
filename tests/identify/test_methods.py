"""The methods beside the default one, and what the paper's equations do when taken literally."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from stimrig import identify
from stimrig.identify import paper
from stimrig.identify.dynamics.linear import Discrete, SecondOrder
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.methods import Method, method_of, methods
from stimrig.identify.methods.transfer_function import choose_order
from tests.harness.patients import Patient, make_record, prbs, ramp

ALL = ("maximum-likelihood", "narx", "ramp-deconvolution", "separable-least-squares", "two-stage")


def scores(record, clean, method, **options):
    model = identify.fit(record, method=method, **options)
    predicted = identify.predict(model, record)
    name = np.array(record.segment_names)[record.segment]
    return model, *(best_fit_percent(clean[name == n], predicted[name == n]) for n in ("ramp", "validate"))


@pytest.fixture(scope="module")
def clean_record():
    return make_record(Patient(), np.random.default_rng(21), rate_hz=40, noise_nm=0.0)


@pytest.fixture(scope="module")
def noisy_record():
    return make_record(Patient(), np.random.default_rng(22), rate_hz=40, noise_nm=0.1)


def test_methods_are_found_by_scanning():
    found = methods()
    assert tuple(found) == ALL
    assert all(isinstance(m, Method) and m.summary for m in found.values())
    assert method_of("two-stage") is found["two-stage"]
    with pytest.raises(identify.BadRequest, match=r"unknown method 'magic'\. Known: maximum-likelihood, narx"):
        method_of("magic")


def test_options_that_a_method_does_not_have(clean_record):
    with pytest.raises(identify.BadRequest, match="unknown option 'taps' of two-stage"):
        identify.fit(clean_record[0], method="two-stage", taps=3)
    with pytest.raises(identify.BadRequest, match="order"):
        identify.fit(clean_record[0], method="two-stage", order="two")
    with pytest.raises(identify.BadRequest, match="invalid option"):
        identify.fit(clean_record[0], knots="many")


@pytest.mark.parametrize("options", [{}, {"order": "auto", "iterations": 3}])
def test_two_stage_recovers_the_muscle(clean_record, options):
    model, ramp, unseen = scores(*clean_record, "two-stage", **options)
    assert ramp >= 99.98
    assert unseen >= 99.9
    assert model.reasons


def test_equations_taken_literally_fail_under_output_noise(clean_record, noisy_record):
    literal = {"order": "2,1,1", "linear": "equation-error"}
    assert scores(*clean_record, "two-stage", **literal)[1] > 99.9
    model, ramp, _ = scores(*noisy_record, "two-stage", **literal)
    assert ramp < 80
    assert model.quality["verdict"] != "usable"
    model, ramp, _ = scores(*noisy_record, "two-stage", order="2,1,1", inverse=True)
    assert ramp < 97
    assert model.quality["verdict"] != "usable"


def test_two_stage_takes_the_users_own_segments(noisy_record):
    record, _ = noisy_record
    names = np.array(record.segment_names)[record.segment]
    renamed = np.select([names == "prbs", names == "ramp"], ["shaking", "triangle"], names)
    own = identify.Record.from_arrays(record.time_s, record.pulse_width_us, record.torque_nm, renamed)
    model = identify.fit(own, method="two-stage", fit_on=("shaking", "triangle"))
    assert model.linear == identify.fit(record, method="two-stage").linear


def test_two_stage_takes_the_two_levels_of_a_mixed_test_and_refuses_levels_alone():
    rng = np.random.default_rng(23)
    levels = np.repeat(rng.permutation(np.linspace(0, 300, 32)), 8)
    parts = [("rest", np.zeros(80)), ("prbs", prbs(6.3, 300, rng)), ("levels", levels), ("rest", np.zeros(120))]
    parts += [("ramp", ramp()), ("rest", np.zeros(80)), ("validate", levels)]
    pulses = np.concatenate([part for _, part in parts]), [name for name, part in parts for _ in part]
    record, clean = make_record(Patient(), rng, rate_hz=40, noise_nm=0.02, pulses=pulses)
    assert min(scores(record, clean, "two-stage")[1:]) > 99.5
    with pytest.raises(identify.NotIdentifiable, match="two-stage needs two levels of pulse width in levels; it has"):
        identify.fit(record, method="two-stage", fit_on=("levels", "ramp"))


def test_ramp_deconvolution_gives_two_curves_and_good_ramps_alone(clean_record):
    model, ramp, unseen = scores(*clean_record, "ramp-deconvolution")
    assert isinstance(model.linear, SecondOrder)
    assert model.linear.damping == 1.0
    assert pytest.approx(0.85 * np.pi) == 1 / model.linear.time_constant_s
    assert ramp > 92
    assert unseen < 85
    curves = model.extra["deconvolved"]
    assert max(curves["rising"]["pulse_width_us"]) > 290
    assert len(curves["falling"]["torque_nm"]) > 150
    # With the right dynamics the two curves meet the true one.
    patient = Patient(damping=1.0, time_constant_s=0.3)
    right = make_record(patient, np.random.default_rng(1), rate_hz=400, noise_nm=0.01)
    model, ramp, unseen = scores(*right, "ramp-deconvolution", natural_frequency_rad_s=1 / 0.3)
    assert ramp > 99.5
    for curve in model.extra["deconvolved"].values():
        width, torque = np.array(curve["pulse_width_us"]), np.array(curve["torque_nm"])
        inner = (width > 30) & (width < 270)
        assert np.max(np.abs(torque - patient.recruitment(width))[inner]) < 0.15


def test_separable_least_squares_needs_the_muscles_memory(clean_record):
    model, ramp, unseen = scores(*clean_record, "separable-least-squares")
    assert isinstance(model.linear, Discrete)
    assert len(model.linear.b) == 41
    assert ramp < 95
    model, ramp, unseen = scores(*clean_record, "separable-least-squares", memory_s=4.0)
    assert len(model.linear.b) == 161
    assert ramp > 99.5
    assert unseen > 99
    with pytest.raises(identify.BadRequest, match="both taps and memory_s"):
        identify.fit(clean_record[0], method="separable-least-squares", taps=3, memory_s=1)


def test_narx_is_scored_in_free_run(clean_record):
    record, _ = clean_record
    model = identify.fit(record, method="narx")
    predicted = identify.predict(model, record)
    recipe = model.extra["narx"]
    assert recipe["terms"]
    # Free run: the measured torque has no part in the prediction.
    assert np.array_equal(identify.predict(model, record.with_torque(record.torque_nm * 0)), predicted)


def without_rests(seed: int) -> tuple[identify.Record, np.ndarray]:
    """A record that begins with a pulse, rests for 0.2 s at most, and is fitted before and after held-out pulses."""
    rng = np.random.default_rng(seed)
    parts = {"prbs": prbs(15.0, 300.0, rng), "validate": np.full(120, 150.0), "ramp": ramp(10.0)}
    parts["prbs"][:8] = 300.0
    pulses = np.concatenate(list(parts.values())), [name for name, part in parts.items() for _ in part]
    return make_record(Patient(time_constant_s=0.3), rng, rate_hz=40, noise_nm=0.03, pulses=pulses)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("two-stage", {"order": "2,1,1"}),
        ("two-stage", {"order": "2,1,1", "linear": "equation-error"}),
        ("maximum-likelihood", {"order": "auto"}),
        ("ramp-deconvolution", {}),
        ("narx", {}),
    ],
)
def test_turned_torque_with_another_zero_gives_the_same_model(method: str, options: dict[str, str]):
    """Also without a rest that shows the zero: the pilot fit knows where the muscle pulls."""
    record, _ = without_rests(1)
    turned = record.with_torque(3.0 - record.torque_nm)
    first_nm, turned_nm = (
        identify.predict(identify.fit(each, method=method, **options), each) for each in (record, turned)
    )
    assert np.max(np.abs(3.0 - turned_nm - first_nm)) < 1e-5


def test_the_zero_is_no_jump_at_rows_that_are_not_fitted():
    """Filtered by 1/A, rows of `validate` count as zero torque: the search for A began far away from the muscle."""
    record, clean = without_rests(2)
    far = record.with_torque(record.torque_nm + 1000.0)
    predicted = identify.predict(identify.fit(far, order="2,1,0"), far) - 1000.0
    assert np.max(np.abs(predicted - identify.predict(identify.fit(record, order="2,1,0"), record))) < 1e-4
    assert np.sqrt(np.mean((predicted - clean) ** 2)) < 0.02


@pytest.mark.parametrize("recruitment", ["spline", "power-series", "sigmoid"])
def test_other_recruitment_curves(clean_record, recruitment):
    model, ramp, _ = scores(*clean_record, "maximum-likelihood", recruitment=recruitment)
    assert ramp > (99.5 if recruitment == "power-series" else 99.98)
    kind = model.to_dict()["recruitment"]["basis"]["kind"]
    assert kind == {"spline": "cubic-spline"}.get(recruitment, recruitment)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_monotone_curves_never_fall(sign):
    record, _ = make_record(Patient(gain=1.5), np.random.default_rng(0), rate_hz=40, noise_nm=0.15)
    signed, width = record.with_torque(sign * record.torque_nm), np.linspace(0, 300, 601)
    free, held = identify.fit(signed), identify.fit(signed, monotone=True)
    assert np.min(np.diff(sign * free.recruitment(width))) < -1e-9, "else nothing is tried"
    assert np.min(np.diff(sign * held.recruitment(width))) > -1e-9
    assert held.fit["rms_nm"] < 1.02 * free.fit["rms_nm"]


def test_order_is_chosen_from_the_data():
    rng = np.random.default_rng(0)
    drive = np.r_[np.zeros(40), prbs(30, 1.0, rng)]
    patient = Patient(time_constant_s=0.2, damping=0.7)
    second = patient.torque(drive * 300, 40) / patient.gain
    first = lfilter([0.0, 0.1], [1.0, -0.9], drive)
    for torque, order in ((second, 2), (first, 1)):
        noisy = torque + 0.01 * rng.standard_normal(torque.size)
        best, reasons = choose_order(noisy, drive, np.ones(drive.size, bool), 1)
        assert len(best.a) - 1 == order and sum("chosen" in reason for reason in reasons) == 1


def test_table1_rows_and_progress():
    seen = []
    found = paper.table1(2, lambda share, text: seen.append((share, text)), noise_levels_nm=(0.0, 0.1))
    assert len(found["rows"]) == 8
    assert seen[-1][0] == pytest.approx(1.0)
    row = {(r["noise_nm"], r["method"]): r for r in found["rows"]}
    assert row[0.1, "two-stage"]["paper"] == 95.33
    assert row[0.0, "two-stage"]["ours"] >= 99.98
    assert row[0.1, "two-stage"]["ours"] >= row[0.1, "two-stage"]["ceiling"] - 0.1
    assert row[0.0, "ramp-deconvolution"]["unseen"] < row[0.0, "ramp-deconvolution"]["clean"] - 10


@pytest.mark.parametrize(("name", "value"), [("delay_s", "nan"), ("delay_s", 10.0), ("knots", 0), ("power", 0)])
def test_an_option_out_of_range_is_refused(name: str, value: object) -> None:
    record, _ = make_record(Patient(), np.random.default_rng(1), rate_hz=40)
    with pytest.raises(identify.BadRequest, match="out of range"):
        identify.fit(record, recruitment="power-series", **{name: value})
