"""Two muscles at one joint, identified together: on records made of the plainest equations."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.identify import muscles
from stimrig.identify.errors import BadModel, BadRecord, BadRequest, NotIdentifiable
from stimrig.identify.muscles.joint_fit import JointFitted, fit_all
from stimrig.identify.muscles.problem import Acting
from stimrig.identify.muscles.search import JointSearch, Tried, drop_idle, search
from stimrig.identify.muscles.verbs import diagnosis_of, improvement_of
from tests.harness import two_muscles

CROSS = "cross_talk:biceps>triceps"


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@cache
def _made(cross_talk: float = 0.0, stiffer: float = 0.0) -> tuple[Any, np.ndarray, dict[str, np.ndarray]]:
    return two_muscles.make(3, cross_talk, stiffer)


@cache
def _fitted(cross_talk: float = 0.0, stiffer: float = 0.0) -> JointFitted:
    return fit_all(_made(cross_talk, stiffer)[0])


@cache
def _model() -> muscles.JointModel:
    return muscles.fit(_made(0.15)[0], interplay=[CROSS])


def test_both_muscles_are_found_from_one_torque() -> None:
    record, true_nm, own = _made()
    found = _fitted()
    whole, shares = found.predicted
    assert _rms((whole - true_nm)[record.held_out]) < 0.02  # noise of a sample: 0.05
    for name, share in zip(record.names, shares, strict=True):
        assert _rms((share - own[name])[record.held_out]) < 0.03, name


def test_the_derivatives_are_those_of_the_torque() -> None:
    names = _made(0.15, 0.2)[0].names
    acting = [Acting.of(CROSS, names), Acting.of("co_contraction:yielding", names)]
    found = _fitted(0.15, 0.2).with_(acting=acting)
    problem, theta = found.problem, found.fitted.theta
    slopes = problem.run(theta, derivatives=True)[1]
    assert slopes is not None
    rng = np.random.default_rng(0)
    for place in [*rng.choice(problem.size, 12, replace=False), problem.size - 1, problem.size - 2]:
        step = 1e-5 * max(abs(theta[place]), 1.0)
        up, down = theta.copy(), theta.copy()
        up[place], down[place] = up[place] + step, down[place] - step
        numeric = (problem.run(up)[0] - problem.run(down)[0]) / (2 * step)
        assert _rms(slopes[place] - numeric) < 0.01 * max(_rms(numeric), 1e-4), place  # a kink has two slopes


def test_the_order_of_the_channels_changes_nothing() -> None:
    record = _made()[0]
    turned = muscles.JointRecord(record.channels[::-1], record.records[::-1])
    for_both = [fit_all(one).predicted[0] for one in (record, turned)]
    assert _rms(for_both[0] - for_both[1]) < 0.005


def test_sign_offset_and_scale_of_the_torque_change_nothing() -> None:
    record = _made()[0]
    before = _fitted()
    after = fit_all(record.with_torque(-3.0 * record.torque_nm + 11.0))
    assert _rms(after.predicted[0] - (-3.0 * before.predicted[0] + 11.0)) < 0.02
    assert np.allclose(after.problem.signs, -before.problem.signs)


def test_a_start_within_a_contraction_changes_little() -> None:
    record, true_nm, _ = _made()
    rows = np.arange(record.time_s.size) >= 4000
    found = fit_all(record.take(rows))
    assert _rms((found.predicted[0] - true_nm[rows])[record.held_out[rows]]) < 0.03


@pytest.mark.parametrize(
    ("cross_talk", "stiffer", "named"),
    [(0.0, 0.0, set()), (0.15, 0.0, {CROSS}), (0.0, 0.25, {"co_contraction"}), (0.15, 0.25, {CROSS, "co_contraction"})],
)
def test_what_the_muscles_do_to_each_other_is_named(cross_talk: float, stiffer: float, named: set[str]) -> None:
    record, true_nm, _ = _made(cross_talk, stiffer)
    found = search(record)
    assert {one.key for one in found.added} == named
    assert _rms((found.last.predicted[0] - true_nm)[record.held_out]) < 0.03


def test_an_interplay_that_a_later_one_made_idle_leaves_no_model_behind() -> None:
    first = _fitted(0.0, 0.25)
    names = first.record.names
    found = JointSearch([first])
    for key in (CROSS, "co_contraction"):
        both = found.last.with_likeliest(Acting.meant(key, names))
        found.append(Tried(key, both.acting[-1].form, both, 99.0))
    drop_idle(found)
    assert [one.key for one in found.added] == ["co_contraction"]
    assert [[one.key(names) for one in model.acting] for model in found.chain] == [[], ["co_contraction"]]
    gained = found.last.fitted.log_evidence - first.fitted.log_evidence
    assert found.added[0].gain == pytest.approx(gained)
    improved = improvement_of(found)
    assert [step["added"] for step in improved.steps] == [None, "co_contraction"]
    assert [len(model.interplay) for model in improved.models] == [0, 1]


def test_a_form_that_is_asked_for_is_the_one_that_is_fitted() -> None:
    record = _made(0.15)[0]
    for form in ("independent", "nested"):
        model = muscles.fit(record, interplay=[f"{CROSS}:{form}", CROSS])
        assert [one["form"] for one in model.interplay] == [form]


def test_hum_is_taken_away_and_told() -> None:
    record = _made(0.15)[0]
    humming = record.with_torque(record.torque_nm + 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s + 0.3))
    found = muscles.fit(humming, interplay=[CROSS])
    assert any("50 Hz" in note for note in found.data["notes"]) and "note" in str(found)
    told = muscles.compare(found, humming)
    assert told["held_out_rms_nm"] < 1.2 * muscles.compare(_model(), record)["held_out_rms_nm"]


def test_clipped_samples_are_left_out() -> None:
    record = _made()[0]
    low, high = np.percentile(record.torque_nm, [3, 97])
    found = search(record.with_torque(np.clip(record.torque_nm, low, high)))
    assert any("end of its range" in note for note in diagnosis_of(found).notes)
    assert not found.added  # before, they were explained twice by `joint.voluntary_effort`


def test_the_size_of_cross_talk_is_told() -> None:
    entry = _model().interplay[0]
    assert entry["from"] == "biceps"
    assert entry["to"] == "triceps"
    share = entry["parameters"]["share"]
    assert abs(share["value"] - 0.15) < 4 * share["sd"] + 0.01


def test_a_model_is_written_and_read_again() -> None:
    record, model = _made(0.15)[0], _model()
    again = muscles.JointModel.from_json(model.to_json())
    assert np.allclose(muscles.predict(again, record), muscles.predict(model, record), atol=1e-9)
    shares = muscles.parts(again, record)
    assert set(shares) == {"biceps", "triceps"}
    assert np.allclose(sum(shares.values()) + again.baseline_nm, muscles.predict(again, record), atol=1e-6)


def test_a_delay_counts_from_a_muscles_own_pulses() -> None:
    for model in _model().models:
        assert abs(model.linear.delay_s) < 1.1 / two_muscles.RATE_HZ  # type: ignore[union-attr]


def test_it_predicts_another_record() -> None:
    other, true_nm, _ = two_muscles.make(3, 0.15, zero_nm=-2.0)  # the same people, moved zero
    predicted = muscles.predict(_model(), other.take(np.arange(8000)))
    assert _rms(predicted - (true_nm[:8000] + 2.7)) < 0.05


def test_a_table_of_two_channels_is_read(tmp_path: Path) -> None:
    record = _made()[0]
    path = tmp_path / "two.csv"
    path.write_text(two_muscles.written(record))
    assert muscles.is_joint(path)
    again = muscles.read(path)
    assert again.names == record.names
    assert again.channels[1].offset_s == pytest.approx(two_muscles.OFFSET_S)
    for mine, own in zip(again.records, record.records, strict=True):
        assert np.allclose(mine.pulse_width_us[100:-100], own.pulse_width_us[100:-100], atol=1e-3)


def test_a_pipe_is_left_to_the_one_who_reads_it() -> None:
    content = b"time_s,biceps_pulse_width_us,triceps_pulse_width_us,torque_nm\n"
    there, here = os.pipe()
    try:
        os.write(here, content)
        os.close(here)
        assert not muscles.is_joint(f"/dev/fd/{there}")
        assert os.read(there, 4096) == content
    finally:
        os.close(there)


def test_bad_records_say_what_is_wrong(tmp_path: Path) -> None:
    record = _made()[0]
    path = tmp_path / "one.csv"
    path.write_text("time_s,pulse_width_us,torque_nm,segment\n0,0,0,rest\n")
    assert not muscles.is_joint(path)
    with pytest.raises(BadRecord, match="one channel"):
        muscles.read(path)
    for names, why in ((["joint", "b"], "called joint"), ([f"c{k}" for k in range(200)], "200 channels")):
        path.write_text("time_s," + "".join(f"{name}_pulse_width_us," for name in names) + "torque_nm,segment\n")
        with pytest.raises(BadRecord, match=why):
            muscles.read(path)
    with pytest.raises(BadRecord, match="channels biceps, biceps"):
        muscles.JointRecord((record.channels[0], record.channels[0]), record.records)
    silent = replace(record.records[1], pulse_width_us=np.zeros(record.time_s.size))
    with pytest.raises(NotIdentifiable, match="no pulse of triceps"):
        muscles.fit(muscles.JointRecord(record.channels, (record.records[0], silent)))
    with pytest.raises(BadRequest, match="no such channels"):
        muscles.fit(record, interplay=["cross_talk:biceps>neck"])
    with pytest.raises(BadRequest, match="unknown interplay"):
        muscles.fit(record, interplay=["telepathy"])
    with pytest.raises(BadRequest, match="no channel 'neck'"):
        muscles.fit(record, effects={"neck": ["fatigue"]})


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: d["channels"].pop(),
        lambda d: d["channels"][1].update(offset_s=1.0),
        lambda d: d["channels"][1].update(name=d["channels"][0]["name"]),
        lambda d: d["interplay"][0]["parameters"]["share"].update(value=7.0),
        lambda d: d["interplay"][0].update({"to": "neck"}),
        lambda d: d["interplay"][0].update(form="magic"),
        lambda d: d.update(kind="tin"),
        lambda d: d["channels"][0].pop("model"),
        lambda d: d["channels"][0].update(name="joint"),
        lambda d: d["channels"][0].update(name="\x1b[31mred"),
        lambda d: d["interplay"].append(d["interplay"][0]),
        lambda d: d["interplay"][0]["parameters"]["share"].update(value=10**400),
        lambda d: d["fit"].update(alone="text"),
        lambda d: d["fit"].update(both=7),
        lambda d: d["data"].update(notes=1),
    ],
)
def test_a_damaged_model_is_refused(damage: Any) -> None:
    document = _model().to_dict()
    damage(document)
    with pytest.raises(BadModel):
        muscles.JointModel.from_dict(document)
