"""Fits of one structure to parts of a record: what they differ by, and when that is more than noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.estimation.contradiction import contradiction
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, make_record
from tests.identify import hidden_muscles


def contradiction_in(record: Record):
    grid, _ = prepare(record)
    return contradiction(fit_plain(grid, grid.fitted))


@pytest.fixture(scope="module")
def exact():
    return [contradiction_in(hidden_muscles.record(seed=seed, rate_hz=100)) for seed in range(10)]


def test_parts_of_an_exact_muscle_differ_by_their_standard_errors(exact):
    statistics = [pair["statistic"] for each in exact for pair in each["pairs"]]
    assert 0.6 < np.mean(statistics) < 1.6
    assert not any(each["significant"] for each in exact)
    assert {tuple(pair["parts"]) for pair in exact[0]["pairs"]} == {
        ("prbs", "ramp"),
        ("the first half", "the second half"),
    }


def test_a_zero_that_wanders_counts_as_noise():
    """As its levels in the rests show it; the parts' own zeros are no contradiction."""
    record = hidden_muscles.record(seed=3, rate_hz=100)
    for wander_nm in (0.02 * record.time_s, 0.4 * np.sin(0.3 * record.time_s)):
        assert not contradiction_in(record.with_torque(record.torque_nm + wander_nm))["significant"]


def test_parts_are_compared_at_the_widths_that_both_played():
    rng, rest = np.random.default_rng(1), np.zeros(80)
    levels = np.repeat(rng.uniform(60.0, 160.0, 40) * (rng.random(40) < 0.6), 10)
    up = np.linspace(0.0, 300.0, 200)
    pulses = np.r_[rest, levels, rest, up, up[::-1], rest]
    names = ["rest"] * 80 + ["prbs"] * levels.size + ["rest"] * 80 + ["ramp"] * 400 + ["rest"] * 80
    record, _ = make_record(Patient(), rng, pulses=(pulses, names), rate_hz=100, noise_nm=0.05)
    pairs = {tuple(pair["parts"]): pair for pair in contradiction_in(record)["pairs"]}
    assert pairs["prbs", "ramp"]["pulse_width_us"][1] < 180.0


def test_a_wrong_structure_contradicts_itself_though_its_error_was_taken_for_slow_noise():
    for hidden in ("asymmetric_relaxation", "fatigue"):
        assert contradiction_in(hidden_muscles.record(hidden, seed=4, rate_hz=100))["significant"], hidden


def test_the_place_is_where_the_muscle_departs():
    """The second half of a record whose torque falls by a fifth from 15 s on."""
    record = hidden_muscles.record(seed=4, rate_hz=100)
    tired = record.with_torque(record.torque_nm * np.where(record.time_s < 15.0, 1.0, 0.8))
    pair = contradiction_in(tired)["pairs"][0]
    assert pair["largest_nm"] > 0.5 and pair["largest_nm"] > 3.0 * pair["largest_error_nm"]
    assert pair["pulse_width_us"][1] > 200.0


def test_comparison_and_its_words_state_it_for_the_record_of_the_model_alone():
    record = hidden_muscles.record("fatigue", seed=4, rate_hz=100)
    model = identify.fit(record)
    result = identify.compare(model, record)
    assert all("parts of this record contradict each other at" in words for words in (str(result), result.plain[-1]))
    assert result.contradiction == model.fit["contradiction"]
    other = identify.compare(model, hidden_muscles.record(seed=5, rate_hz=100))
    assert other.contradiction is None and "contradict" not in str(other)


def test_a_record_of_one_short_part_says_nothing():
    record = hidden_muscles.record(seed=4, rate_hz=100)
    rows = slice(0, round(4.0 * 100))
    short = replace(
        record,
        **{name: getattr(record, name)[rows] for name in ("time_s", "pulse_width_us", "torque_nm", "segment")},
    )
    assert contradiction_in(short) is None
