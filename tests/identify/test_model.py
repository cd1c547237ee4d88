"""MODEL.json: what the controller gets must give what the model predicts, with nothing but the file."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from stimrig import identify
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.quality import range_warnings
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import PowerBasis, SigmoidBasis, SplineBasis
from tests.harness.patients import Patient, make_record

KEYS = {
    "schema_version", "model_id", "sample_rate_hz", "method", "created", "linear", "recruitment", "valid_for",
    "uncertainty", "effects", "fit", "residual_tests", "data", "software",
}  # fmt: skip


@cache
def fitted(rate_hz: int) -> tuple[Record, identify.Model]:
    patient = Patient(delay_s=0.0137, time_constant_s=0.3)
    record, _ = make_record(patient, np.random.default_rng(1), rate_hz=rate_hz, noise_nm=0.03)
    return record, identify.fit(record)


@pytest.fixture(params=[40, 1600])
def case(request) -> tuple[Record, identify.Model]:
    return fitted(request.param)


def test_holds_what_the_contract_names(case):
    document = json.loads(case[1].to_json())
    assert set(document) >= KEYS
    assert set(document["linear"]) >= {"b", "a", "delay_samples"}
    assert set(document["recruitment"]) >= {"pulse_width_us", "torque_nm", "inverse", "basis"}
    assert sum(document["linear"]["b"]) / sum(document["linear"]["a"]) == pytest.approx(1.0, abs=1e-9)
    assert document["recruitment"]["torque_nm"][0] == 0
    assert set(document["uncertainty"]) >= {"covariance", "bands"}
    assert len(json.dumps(document)) < 400_000


def test_a_controller_that_reads_only_the_file_predicts_the_same(case):
    record, model = case
    document = json.loads(model.to_json())
    drive = np.interp(
        record.pulse_width_us, document["recruitment"]["pulse_width_us"], document["recruitment"]["torque_nm"]
    )
    linear = document["linear"]
    b = np.r_[np.zeros(linear["delay_samples"]), linear["b"]]
    torque = lfilter(b, linear["a"], drive) + document["baseline_nm"]
    predicted = identify.predict(model, record)
    assert np.max(np.abs(torque - predicted)) < 0.004 * np.ptp(predicted)


def test_the_inverse_inverts(case):
    curve = case[1].recruitment
    turned = case[1].with_(recruitment=replace(curve, coefficients_nm=-curve.coefficients_nm))
    for model in (case[1], turned):
        inverse = model.to_dict()["recruitment"]["inverse"]
        width = np.array(inverse["pulse_width_us"])
        assert np.all(np.diff(width) >= 0) and abs(inverse["torque_nm"][-1]) > 5
        assert model.recruitment(width) == pytest.approx(inverse["torque_nm"], abs=0.003)


def test_survives_the_way_through_json(case):
    record, model = case
    again = identify.Model.from_json(model.to_json())
    assert np.array_equal(identify.predict(again, record), identify.predict(model, record))
    assert again.to_dict() == model.to_dict()


def test_bad_models_are_refused(case):
    document = case[1].to_dict()
    for spoiled, says in (
        ("{", "not JSON"),
        ("[]", "JSON object"),
        ("{}", "schema version"),
        (json.dumps(document | {"schema_version": "9.0"}), "schema version 9.0"),
        (json.dumps({k: v for k, v in document.items() if k != "linear"}), "linear: the key is missing"),
        (json.dumps(document | {"linear": {"kind": "second-order", "time_constant_s": "x"}}), "'x' is not a number"),
        (json.dumps(document | {"recruitment": {"basis": {"kind": "magic"}}}), "'magic' is not cubic-spline or"),
    ):
        with pytest.raises(identify.BadModel, match=says):
            identify.Model.from_json(spoiled)


@pytest.mark.parametrize(("damping", "delay_s"), [(0.3, 0.0), (1.0, 0.004), (1.0, 0.025), (2.5, 0.06)])
def test_discrete_coefficients_are_exact_for_a_held_input(delay_s, damping):
    linear = SecondOrder(0.2, damping, delay_s)
    b, a, d = linear.discrete(40.0)
    rng = np.random.default_rng(0)
    widths = np.repeat(rng.uniform(0, 300, 20), 10)
    patient = Patient(time_constant_s=0.2, damping=damping, delay_s=delay_s)
    assert lfilter(np.r_[np.zeros(d), b], a, patient.recruitment(widths)) == pytest.approx(
        patient.torque(widths, 40), abs=1e-6
    )


@pytest.mark.parametrize(
    "basis", [SplineBasis(np.array([0, 50, 120, 130, 300.0])), PowerBasis(4, 300.0), SigmoidBasis(0.04, 2000.0)]
)
def test_every_basis_is_zero_at_zero_and_knows_its_slope(basis):
    curve = Curve(basis, np.linspace(1, 2, basis.size))
    u = np.linspace(1, 299, 57)
    assert curve(np.zeros(1))[0] == 0
    numeric = (curve(u + 1e-4) - curve(u - 1e-4)) / 2e-4
    assert curve(u, 1) == pytest.approx(numeric, rel=1e-4, abs=1e-8)
    second = (curve(u + 1e-3, 1) - curve(u - 1e-3, 1)) / 2e-3
    assert basis.design(u, 2) @ curve.coefficients_nm == pytest.approx(second, rel=2e-3, abs=1e-7)
    width, torque = curve.table()
    fine = np.linspace(0, 300, 4001)
    assert np.interp(fine, width, torque) == pytest.approx(curve(fine), abs=1e-3 * np.ptp(torque))


def test_warns_and_refuses_outside_what_it_holds_for(case):
    record, model = case
    assert range_warnings(model, record) == []
    wider = replace(record, pulse_width_us=record.pulse_width_us * 1.5)
    assert any("above the largest fitted" in warning for warning in range_warnings(model, wider))
    assert "above the largest fitted" in identify.compare(model, wider).plain[-1]
    with pytest.raises(identify.BadModel, match="pulses a second"):
        identify.predict(model, replace(record, pulse_rate_hz=20.0))
    slightly = replace(record, pulse_rate_hz=44.0)
    assert any("fit a model at that rate" in warning for warning in range_warnings(model, slightly))


def test_a_polynomial_whose_parts_do_not_go_together_is_refused(case):
    document = case[1].to_dict()
    narx = {
        "variables": [[0, 1]], "terms": [[0]], "weights": [1.0], "torque_scale_nm": 1.0, "width_scale_us": 1.0,
        "baseline_nm": 0.0,
    }  # fmt: skip
    identify.Model.from_dict(document | {"extra": {"narx": narx}})
    for change, says in (({"terms": [[0], []]}, "differ in number"), ({"terms": [[1]]}, "does not exist")):
        with pytest.raises(identify.BadModel, match=says):
            identify.Model.from_dict(document | {"extra": {"narx": narx | change}})
