"""Sequences: shape, range, dose, and that the library finds them by file."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig.rig import sequences
from stimrig.rig.errors import PlanError
from stimrig.rig.sequences import prbs


@pytest.mark.parametrize("bits", sorted(prbs.FEEDBACK_TAPS))
def test_shift_register_is_of_maximum_length(bits: int):
    period = 2**bits - 1
    chips = prbs.shift_register(bits, 2 * period)
    assert np.array_equal(chips[:period], chips[period:])
    assert chips[:period].sum() == 2 ** (bits - 1)  # one more 1 than 0
    states = {tuple(chips[i : i + bits]) for i in range(period)}
    assert len(states) == period  # every state but zero, once


def test_prbs_defaults_take_12_7_s_between_0_and_c():
    widths = sequences.build("prbs", {"max_pulse_width_us": 280.0}, 40.0)
    assert len(widths) / 40.0 == pytest.approx(12.7)
    assert set(widths) == {0.0, 280.0}
    assert np.all(np.diff(np.flatnonzero(np.diff(widths))) % 4 == 0)


def test_prbs_seed_shifts_the_sequence():
    first = sequences.build("prbs", {"seed": 1}, 40.0)
    other = sequences.build("prbs", {"seed": 77}, 40.0)
    assert not np.array_equal(first, other)
    assert first.sum() == other.sum()


def test_ramp_rises_to_c_and_falls_to_zero():
    widths = sequences.build("ramp", {}, 40.0)
    assert len(widths) == 400
    assert widths.max() == widths[199] == 300.0
    assert widths[-1] == 0.0
    assert np.all(np.diff(widths[:200]) > 0)
    assert np.all(np.diff(widths[199:]) < 0)


def test_multilevel_holds_and_covers_the_range():
    widths = sequences.build("multilevel", {}, 40.0)
    assert len(widths) == 280
    levels = np.unique(widths)
    assert len(levels) >= 7
    assert levels[0] == 0.0
    assert levels[-1] > 0.8 * 300
    edges = np.flatnonzero(np.diff(widths)) + 1
    holds = np.diff(np.concatenate([[0], edges]))
    assert holds.min() >= 12


def test_staircase_and_steps():
    stairs = sequences.build("staircase", {"levels": 3, "hold_s": 0.5}, 40.0)
    assert list(stairs[::20]) == [100.0, 200.0, 300.0, 200.0, 100.0, 0.0]
    steps = sequences.build("steps", {"repeats": 2, "on_s": 1.0, "off_s": 0.5}, 40.0)
    assert steps.sum() == 2 * 40 * 300.0
    assert len(steps) == 120


@given(st.sampled_from(sorted(set(sequences.library()) - {"widths"})), st.floats(20, 60), st.floats(1, 500))
def test_every_sequence_stays_between_zero_and_c(name: str, rate_hz: float, c_us: float):
    scaled = "max_pulse_width_us" in sequences.find(name).Settings.model_fields
    settings = {"max_pulse_width_us": c_us} if scaled else {}
    widths = sequences.build(name, settings, rate_hz)
    assert len(widths) == sequences.pulse_count(name, settings, rate_hz)
    assert widths.dtype == np.float64
    assert np.all((widths >= 0) & (widths <= c_us * (1 + 1e-12)))
    assert widths.max() > 0.8 * c_us if scaled else widths.max() == 0, "only a rest has no width to scale"
    assert np.array_equal(widths, sequences.build(name, settings, rate_hz))  # pure


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("prsb", {}, f"use one of {', '.join(sequences.library())}"),
        ("prbs", {"bit": 7}, "prbs.bit"),
        ("prbs", {"bits": "seven"}, "prbs.bits"),
        ("prbs", {"bits": 40}, "prbs.bits"),
        ("rest", {"duration_s": float("nan")}, "rest.duration_s"),
        ("widths", {"pulse_width_us": []}, "widths.pulse_width_us"),
        ("widths", {"pulse_width_us": [1, "wide"]}, "widths.pulse_width_us.1"),
        ("multilevel", {"min_hold_s": 2.0}, "min_hold_s must not exceed max_hold_s"),
        ("ramp", {"up_s": 0.001}, "at least one pulse"),
        ("steps", {"on_s": True}, "valid"),
        ("rest", {"duration_s": "2"}, "valid"),
        ("widths", {"pulse_width_us": [True]}, "valid"),
        ("prbs", {"bits": True}, "valid"),
    ],
)
def test_mistakes_name_the_setting(name: str, settings: dict[str, object], words: str):
    with pytest.raises(PlanError, match=words.replace(".", r"\.")):
        sequences.build(name, settings, 40.0)
