"""Records no one should have made: every method answers with a model and its verdict, or with one clear line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from stimrig import identify
from stimrig.identify.methods import methods
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, make_record

METHODS = tuple(methods())


def base() -> Record:
    return make_record(Patient(), np.random.default_rng(1), rate_hz=100, noise_nm=0.05)[0]


def cut(record: Record, *names: str) -> Record:
    return record.take(np.isin(np.array(record.segment_names)[record.segment], names))


def answer(record: Record, method: str) -> identify.Model | identify.IdentifyError:
    """A model that can be written and read again, or an error of ours."""
    try:
        model = identify.fit(record, method=method)
    except identify.IdentifyError as error:
        assert "\n" not in str(error)
        return error
    again = identify.Model.from_json(model.to_json())
    assert np.allclose(again.predict(record), model.predict(record), equal_nan=True)
    assert model.quality["verdict"] in {"usable", "usable with care", "not usable"}
    json.loads(model.to_json())
    return model


@pytest.mark.parametrize("method", METHODS)
def test_nothing_happens(method):
    still = base()
    for record in (
        replace(still, pulse_width_us=np.zeros_like(still.pulse_width_us)),
        still.with_torque(np.zeros_like(still.torque_nm)),
        still.with_torque(np.full_like(still.torque_nm, 3.0)),
        Record.from_arrays(np.array([0.0]), np.array([0.0]), np.array([0.0])),
        Record.from_arrays(still.time_s, still.pulse_width_us, still.torque_nm, ["validate"] * still.time_s.size),
    ):
        assert isinstance(answer(record, method), identify.IdentifyError)


def test_constant_input_is_not_identifiable():
    size = 4000
    record = Record.from_arrays(
        np.arange(size) / 100, np.full(size, 200.0), np.random.default_rng(0).standard_normal(size)
    )
    error = answer(record, "maximum-likelihood")
    assert isinstance(error, identify.NotIdentifiable)
    assert "never changes" in str(error)


def test_a_train_of_a_calibration_is_fitted_and_not_diagnosed():
    patient = Patient()
    width_us = np.r_[np.zeros(10), np.full(80, 200.0), np.zeros(10)]  # the longest train that a rig gives
    torque_nm = patient.torque(width_us, 200.0)
    torque_nm += 0.05 * np.random.default_rng(2).standard_normal(torque_nm.size)
    train = Record.from_arrays(np.arange(torque_nm.size) / 200, np.repeat(width_us, 5), torque_nm)
    assert identify.fit(train).quality["verdict"] == "usable with care"
    for search in (identify.diagnose, identify.improve):
        with pytest.raises(identify.NotIdentifiable, match="only 100 pulse intervals may be fitted"):
            search(train)


@pytest.mark.parametrize("method", METHODS)
def test_noise_alone_is_not_usable(method):
    record = base()
    found = answer(record.with_torque(np.random.default_rng(0).standard_normal(record.time_s.size)), method)
    assert isinstance(found, identify.Model)
    assert found.quality["verdict"] == "not usable"


@pytest.mark.parametrize("method", METHODS)
def test_a_saturated_sensor_is_never_plainly_usable(method):
    record = base()
    found = answer(record.with_torque(np.minimum(record.torque_nm, 3.0)), method)
    assert isinstance(found, identify.Model)
    assert found.quality["verdict"] != "usable"
    assert not found.quality["gates"]["sensor"]["passed"]


def test_a_method_says_which_segment_it_needs():
    with pytest.raises(identify.NotIdentifiable, match="two-stage needs a segment prbs"):
        identify.fit(cut(base(), "rest", "ramp"), method="two-stage")
    with pytest.raises(identify.NotIdentifiable, match="two-stage needs a segment ramp"):
        identify.fit(cut(base(), "rest", "prbs"), method="two-stage")
    with pytest.raises(identify.NotIdentifiable, match="ramp-deconvolution needs a segment ramp"):
        identify.fit(cut(base(), "rest", "prbs"), method="ramp-deconvolution")


def test_numbers_that_are_none():
    record = base()
    for column in ("time_s", "pulse_width_us", "torque_nm"):
        for value in (np.nan, np.inf):
            spoiled = getattr(record, column).copy()
            spoiled[77] = value
            with pytest.raises(identify.BadRecord, match=rf"{column}, sample 7[78]"):
                identify.fit(replace(record, **{column: spoiled}))
    backwards = record.time_s.copy()
    backwards[50] = backwards[49] - 1
    with pytest.raises(identify.BadRecord, match="time does not rise"):
        identify.fit(replace(record, time_s=backwards))
    with pytest.raises(identify.BadRecord, match="negative"):
        identify.fit(replace(record, pulse_width_us=record.pulse_width_us - 1))


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    size=st.integers(1, 400),
    rate=st.sampled_from([40.0, 100.0, 333.0, 1600.0]),
    pulse_rate=st.sampled_from([20.0, 33.0, 40.0]),
    seed=st.integers(0, 2**32 - 1),
    widths=st.sampled_from(["none", "one", "two", "many"]),
    torque=st.sampled_from(["zero", "noise", "steps", "huge", "spike"]),
    names=st.lists(st.sampled_from(["rest", "prbs", "ramp", "validate", "my own"]), min_size=1, max_size=5),
    method=st.sampled_from(METHODS),
)
@example(400, 100.0, 20.0, 4, "many", "huge", ["prbs", "validate"], "maximum-likelihood")
def test_any_record_gets_an_answer(size, rate, pulse_rate, seed, widths, torque, names, method):
    rng = np.random.default_rng(seed)
    each = max(int(rate / pulse_rate), 1)
    levels = {"none": [0.0], "one": [150.0], "two": [0.0, 300.0], "many": np.linspace(0, 300, 50)}[widths]
    width = np.repeat(rng.choice(levels, size // each + 1), each)[:size]
    noise = rng.standard_normal(size)
    measured = {
        "zero": np.zeros(size),
        "noise": noise,
        "steps": width / 100 + 0.01 * noise,
        "huge": 1e12 * noise,
        "spike": np.where(np.arange(size) == size // 2, 1e6, 0.0),
    }[torque]
    segment = np.repeat(names, size // len(names) + 1)[:size]
    record = Record.from_arrays(np.arange(size) / rate, width, measured, segment, pulse_rate_hz=pulse_rate)
    answer(record, method)
