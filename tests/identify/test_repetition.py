"""The yardstick of repetition: simulated repeats whose variance is known, and records in which nothing repeats."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.estimation.repetition import repetition
from stimrig.identify.estimation.samples import block_means
from stimrig.identify.records.record import Record
from stimrig.identify.yardstick import floor_nm, repetition_words
from tests.harness.muscle import Patient
from tests.harness.patients import as_record, make_record, prbs, ramp

WHITE_NM = 0.05
REST = np.zeros(160)
QUICK = Patient(time_constant_s=0.12)
Part = tuple[str, np.ndarray]


def parts_of(rng: np.random.Generator, bouts: int, name: str = "validate") -> list[Part]:
    last: list[Part] = [(name, ramp(6)), ("rest", REST)]
    return [
        ("rest", REST),
        ("prbs", prbs(10, 300.0, rng)),
        ("rest", REST),
        *[("ramp", ramp(6)), ("rest", REST)] * (bouts - 1),
        *last,
    ]


def simulated(parts: list[Part], rng: np.random.Generator, wander_nm: float = 0.0, rate_hz: float = 400.0) -> Record:
    """White noise, and a zero of its own in each part (its rest before it included)."""
    widths = np.concatenate([width for _, width in parts])
    names = [name for name, width in parts for _ in width]
    record, _ = make_record(QUICK, rng, rate_hz=rate_hz, noise_nm=WHITE_NM, pulses=(widths, names))
    numbers = np.repeat(np.arange(len(parts)), [width.size for _, width in parts])
    slot = np.minimum((record.time_s * 40 + 1e-6).astype(int), numbers.size - 1)
    zero_nm = rng.standard_normal(len(parts)) * wander_nm
    return record.with_torque(record.torque_nm + zero_nm[numbers[slot]])


def of(record: Record, error_nm: float | np.ndarray = 0.0) -> dict[str, Any]:
    grid = make_grid(record)
    return repetition(grid, np.broadcast_to(error_nm, grid.size).astype(float), grid.fitted)


def test_white_noise_is_all_that_differs_between_repeats():
    found = of(simulated(parts_of(np.random.default_rng(1), 4), np.random.default_rng(2)))
    assert found["found_by"] == "exact repeats"
    assert found["repeats"] == 4.0
    # The mean of ten samples; of four repeats some 240 intervals each.
    assert found["rms_nm"] == pytest.approx(WHITE_NM / 10**0.5, rel=0.06)
    # The mean of three others is not exact either: √(1 + 1/3).
    assert found["held_out_rms_nm"] == pytest.approx(WHITE_NM / 10**0.5 * (4 / 3) ** 0.5, rel=0.12)


def test_what_the_model_explains_of_what_repeats():
    record = simulated(parts_of(np.random.default_rng(4), 4), np.random.default_rng(5))
    grid = make_grid(record)
    perfect = of(record, 0.0)
    held = np.flatnonzero(grid.held_out)
    shape = grid.torque_nm - np.mean(grid.torque_nm[held])
    assert perfect["explained_percent"] == 100.0
    # A model that leaves a constant share of the torque's shape: the rest of its power is explained.
    for share in (0.3, 0.5):
        found = of(record, share * shape)
        assert found["explained_percent"] == pytest.approx(100 * (1 - share**2), abs=1.5)
        assert found["held_out_model_rms_nm"] == pytest.approx(found["model_rms_nm"], rel=0.05)
    assert of(record, 3.0 * shape)["explained_percent"] == 0.0


def test_no_share_is_told_where_what_differs_may_hide_any_error():
    """One of six bouts without torque: any model errs no more than such repeats do."""
    rng = np.random.default_rng(20)
    parts = parts_of(rng, 6)
    record = simulated(parts, rng)
    ends = np.cumsum([width.size for _, width in parts]) / 40.0
    dead = (ends[4] < record.time_s) & (record.time_s < ends[6])
    assert [parts[place][0] for place in (5, 6)] == ["ramp", "rest"]
    found = of(record.with_torque(np.where(dead, 0.0, record.torque_nm)), 2.0)
    assert found["found_by"] == "exact repeats" and found["explained_percent"] is None
    assert "too much to tell a share" in repetition_words({"repetition": found})


def test_offset_sign_scale_and_rate_change_nothing():
    parts = parts_of(np.random.default_rng(6), 4)
    record = simulated(parts, np.random.default_rng(7), 0.1)
    first = of(record)
    for scale, offset in ((-1.0, 0.0), (1.0, 50.0), (10.0, -3.0)):
        found = of(record.with_torque(scale * record.torque_nm + offset))
        assert found["rms_nm"] == pytest.approx(abs(scale) * first["rms_nm"], rel=1e-6)
        assert found["held_out_rms_nm"] == pytest.approx(abs(scale) * first["held_out_rms_nm"], rel=1e-6)
        assert (found["repeats"], found["explained_percent"]) == (first["repeats"], first["explained_percent"])
    for rate_hz in (40.0, 1000.0):
        found = of(simulated(parts, np.random.default_rng(7), 0.3, rate_hz))
        assert found["repeats"] == 4.0
        assert found["seconds"] == pytest.approx(first["seconds"], abs=0.1)


@pytest.mark.parametrize("change", ["rounded", "later"])
def test_repeats_to_a_microsecond_and_a_pulse(change: str):
    rng = np.random.default_rng(10)
    parts = parts_of(rng, 4)
    third = next(index for index, (name, _) in reversed(list(enumerate(parts))) if name == "ramp")
    width = np.round(parts[third][1]) if change == "rounded" else np.r_[0.0, parts[third][1][:-1]]
    parts[third] = ("ramp", width)
    found = of(simulated(parts, rng))
    assert found["repeats"] == pytest.approx(4.0, abs=0.02)
    assert found["rms_nm"] < 2.0 * WHITE_NM / 10**0.5


def test_parts_within_a_segment_repeat_too():
    """Equal bouts of a level, in one segment of other things; what is level for long still counts."""
    rng = np.random.default_rng(11)
    bout = np.r_[np.full(100, 200.0), np.zeros(120)]
    widths = np.r_[REST, bout, prbs(5, 300.0, rng), REST, bout, bout, rng.uniform(0, 300, 200), REST]
    torque = QUICK.torque(widths, 400.0)
    record = as_record(torque + WHITE_NM * rng.standard_normal(torque.size), widths, 400.0)
    found = of(record)
    assert found["repeats"] == pytest.approx(3.0, abs=0.2)
    assert found["rms_nm"] == pytest.approx(WHITE_NM / 10**0.5, rel=0.12)


def test_what_a_model_foresees_is_not_called_unforeseeable():
    """Of a slow muscle, whose torque still falls in the rests, it was 0.10 N·m; the model erred by 0.02."""
    found = {"found_by": "estimate", "rms_nm": 0.1, "model_rms_nm": 0.02, "repeats": None, "explained_percent": None}
    assert floor_nm(found) is None and floor_nm(found | {"model_rms_nm": 0.2}) == 0.1
    said = repetition_words({"repetition": found})
    assert "no model can foresee" not in said and "the model's error is smaller" in said
    nearly = repetition_words({"repetition": found | {"model_rms_nm": 0.2, "explained_percent": 99.97}})
    assert "more than 99.9 %" in nearly and "100" not in nearly


@pytest.mark.parametrize("time_constant_s", [0.3, 0.6])
def test_what_a_slow_muscle_still_relaxes_at_rest_is_no_scatter(time_constant_s: float):
    rng = np.random.default_rng(13)
    widths = np.concatenate([width for _, width in parts_of(rng, 1)])
    torque = Patient(time_constant_s=time_constant_s).torque(widths, 400.0)
    found = of(as_record(torque + WHITE_NM * rng.standard_normal(torque.size), widths, 400.0), 1.0)
    assert found["found_by"] == "estimate"
    assert found["rms_nm"] == pytest.approx(WHITE_NM / 10**0.5, rel=0.1)


def test_what_never_repeats_claims_nothing_exact():
    rng = np.random.default_rng(12)
    record, _ = make_record(QUICK, rng, noise_nm=WHITE_NM)
    model = identify.fit(record)
    found = model.fit["repetition"]
    assert found["found_by"] == "estimate"
    assert found["repeats"] is None and found["held_out_rms_nm"] is None
    assert found["rms_nm"] == pytest.approx(WHITE_NM / 10**0.5, rel=0.2)
    assert "so much at least" in repetition_words(model.fit)
    # A width for each pulse and no rest: nothing is known.
    widths = rng.uniform(0.0, 300.0, 2000)
    torque = QUICK.torque(widths, 100.0)
    assert set(of(as_record(torque, widths, 100.0)).values()) == {None}
    # Only level or at rest: that is no repeat.
    level = np.r_[np.zeros(400), np.full(400, 200.0), np.zeros(400)]
    assert of(as_record(QUICK.torque(level, 100.0), level, 100.0))["found_by"] == "estimate"


def test_doubted_intervals_and_gaps_do_not_count():
    record = simulated(parts_of(np.random.default_rng(13), 4), np.random.default_rng(14))
    ramps = np.flatnonzero(np.array(record.segment_names)[record.segment] == "ramp")
    doubted = np.zeros(record.time_s.size, bool)
    doubted[ramps[0] - 100 : ramps[0] + 2400] = True
    found = of(replace(record, doubted=doubted).with_torque(record.torque_nm + 9.0 * doubted))
    assert found["repeats"] == pytest.approx(3.0, abs=0.1)
    assert found["rms_nm"] == pytest.approx(WHITE_NM / 10**0.5, rel=0.1)


def test_rows_that_were_fitted_are_judged_as_left_out():
    """Repeats outside `validate`: the model's error there is that of a fit without them, in every report."""
    widths = np.concatenate([REST, ramp(6), REST, ramp(6), REST, prbs(10, 300.0, np.random.default_rng(3))])
    names = ["rest"] * 160 + ["ramp"] * 240 + ["rest"] * 160 + ["ramp"] * 240 + ["rest"] * 160
    names += ["validate"] * (widths.size - len(names))
    record, _ = make_record(QUICK, np.random.default_rng(4), rate_hz=100, noise_nm=0.5, pulses=(widths, names))
    model = identify.fit(record)
    found = model.fit["repetition"]
    error_nm = block_means(make_grid(record), record.torque_nm - model.predict(record))
    assert found["found_by"] == "exact repeats"
    assert found["model_rms_nm"] > 1.001 * of(record, error_nm)["model_rms_nm"]
    assert identify.compare(model, record).repetition == found


def test_reports_have_it():
    record = simulated(parts_of(np.random.default_rng(15), 4), np.random.default_rng(16), 0.1, 100.0)
    model = identify.fit(record)
    for shown in (model, identify.compare(model, record)):
        assert "4 repeats of the same pulses" in str(shown)
    assert repetition_words({}) == "–"
