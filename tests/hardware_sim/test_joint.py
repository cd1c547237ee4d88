"""Two muscles at one joint: the truth that is told is met, units that two electrodes reach are one, nothing is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.joint import Joint, LiveJoint
from stimrig.hardware_sim.joint_records import draw_joint, record

PULSES = 400
SLOT_S = np.array([[0.0], [0.0125]]) + 0.025 * np.arange(PULSES)


def widths(joint: Joint, seed: int = 1) -> Floats:
    """Levels of both channels, each held for five pulses."""
    tops = np.array([[one.largest_width_us] for one in joint.muscles])
    return np.round(np.repeat(np.random.default_rng(seed).uniform(0.0, 1.0, (2, PULSES // 5)), 5, axis=1) * tops)


def settled(joint: Joint, first_us: float, second_us: float) -> dict[str, Floats]:
    """Torques after six seconds of even pulses."""
    made = record(joint, np.full(240, first_us), np.full(240, second_us), noise_sd_nm=0.0)
    return {name: made[name][-80:].mean(axis=0) for name in ("clean_nm", "muscle_nm")}


def play(joint: Joint, widths_us: Floats, late_s: Floats | float = 0.0) -> Floats:
    """What a cell reads at 1600 Hz, pulse by pulse."""
    live = LiveJoint(joint)
    at_s = SLOT_S + late_s
    pulses = sorted((float(at_s[m, i]), m, float(widths_us[m, i])) for m in (0, 1) for i in range(PULSES))
    torque_nm, sent = np.empty(PULSES * 40), 0
    for k in range(torque_nm.size):
        while sent < len(pulses) and pulses[sent][0] <= k / 1600 + 1e-9:
            time_s, m, width_us = pulses[sent]
            if width_us > 0.0:
                live.electrodes[m].pulse(time_s, width_us, 20.0)
            sent += 1
        torque_nm[k] = live.torque_nm(k / 1600)
    return torque_nm


@pytest.mark.parametrize("asked", [0.0, 0.03, 0.15, 0.3])
def test_cross_talk_is_what_it_is_defined_to_be(asked: float) -> None:
    for seed in range(6):
        joint = draw_joint(seed, cross_talk=asked, co_contraction=0.0, plain=True)
        largest = [one.largest_width_us for one in joint.muscles]
        own = settled(joint, largest[0], 0.0)["muscle_nm"], settled(joint, 0.0, largest[1])["muscle_nm"]
        by_first, by_second = own[0][1] / own[1][1], own[1][0] / own[0][0]
        assert (by_first, by_second) == pytest.approx((asked, asked), abs=0.002)
        assert joint.cross_talk == pytest.approx((by_first, by_second), abs=0.002)


def test_co_contraction_is_what_it_is_defined_to_be() -> None:
    joint = draw_joint(3, cross_talk=0.0, co_contraction=0.2, plain=True)
    both = settled(joint, *(one.largest_width_us for one in joint.muscles))
    assert both["clean_nm"] == pytest.approx(0.8 * both["muscle_nm"].sum(), rel=1e-3)
    assert joint.truth["co_contraction"] == pytest.approx(0.2)


def test_units_that_both_electrodes_reach_are_the_same_units() -> None:
    for seed in range(6):
        joint = draw_joint(seed, cross_talk=0.3, co_contraction=0.0, plain=True)
        agonist = joint.agonist
        top = [one.largest_width_us for one in joint.muscles]
        other = joint.active_nm(np.array([[0.0, top[1]]]))[0, 0]
        each = joint.active_nm(np.array([[0.6 * top[0], 0.0]]))[0, 0]
        union = joint.active_nm(np.array([[0.6 * top[0], top[1]]]))[0, 0]
        assert max(other, each) <= union <= other + each
        reached = np.count_nonzero((agonist.own_us <= 0.6 * top[0]) & (agonist.other_us <= top[1]))
        assert union == pytest.approx(other + each - reached * agonist.unit_nm)
    everything = settled(joint, *top)["muscle_nm"]
    alone = settled(joint, top[0], 0.0)["muscle_nm"]
    assert everything[0] < 1.001 * alone[0] + agonist.unit_nm * np.count_nonzero(
        (agonist.own_us > top[0]) & (agonist.other_us <= top[1])
    )


def test_without_interplay_torques_add_up_and_a_muscle_alone_is_that_muscle() -> None:
    joint = draw_joint(4, cross_talk=0.0, co_contraction=0.0)
    first, second = widths(joint)
    rest = np.zeros(PULSES)
    both, one, other = (record(joint, *pair) for pair in ((first, second), (first, rest), (rest, second)))
    np.testing.assert_allclose(both["clean_nm"], one["clean_nm"] + other["clean_nm"], atol=1e-9)
    np.testing.assert_allclose(both["muscle_nm"][:, 0], one["clean_nm"], atol=1e-9)
    assert one["clean_nm"].max() > 1.0 and other["clean_nm"].min() < -1.0
    interplay = draw_joint(4, cross_talk=0.2, co_contraction=0.2)
    both, one, other = (record(interplay, *pair) for pair in ((first, second), (first, rest), (rest, second)))
    assert np.abs(both["clean_nm"] - one["clean_nm"] - other["clean_nm"]).max() > 0.3


def test_live_and_off_line_are_one_joint() -> None:
    for seed in (2, 7):
        joint = draw_joint(seed, cross_talk=0.2, co_contraction=0.15)
        made = record(joint, *widths(joint), rate_hz=1600)
        np.testing.assert_allclose(play(joint, widths(joint)), made["clean_nm"], atol=1e-9)


def test_jitter_delays_but_tears_no_holes() -> None:
    joint = draw_joint(5, cross_talk=0.2, co_contraction=0.15, plain=True)
    even = np.array([[0.6 * one.largest_width_us] * PULSES for one in joint.muscles])
    late_s = np.random.default_rng(1).uniform(0.0, 0.004, (2, PULSES))
    steady, jittered = play(joint, even, 0.002), play(joint, even, late_s)
    assert np.abs(steady).max() > 0.5
    after = slice(1600, -200)
    np.testing.assert_allclose(jittered[after], steady[after], atol=0.02 * np.abs(steady).max())
    lost = steady[after].mean() - jittered[after].mean()
    assert abs(lost) < 0.002 * np.abs(steady).max()


@pytest.mark.parametrize("late_ms", [7.0, 12.0, 18.0])
def test_a_late_pulse_acts_whole_and_so_does_the_next(late_ms: float) -> None:
    joint = draw_joint(6, cross_talk=0.0, co_contraction=0.0, plain=True)
    even = np.array([[0.7 * one.largest_width_us] * PULSES for one in joint.muscles])
    even[1] = 0.0
    late_s = np.zeros((2, PULSES))
    late_s[0, [100, 110, 111, 130]] = late_ms / 1e3
    steady, moved = play(joint, even), play(joint, even, late_s)
    drive = float(steady.mean()) * 0.025  # of one pulse, N·m·s
    assert np.abs(moved - steady).max() > 0.001 * np.abs(steady).max()
    assert abs(float(np.sum(moved - steady)) / 1600) < 0.1 * drive


def test_a_pulse_left_out_leaves_a_gap_in_its_own_muscle_only() -> None:
    joint = draw_joint(8, cross_talk=0.0, co_contraction=0.0, plain=True)
    even = np.array([[0.7 * one.largest_width_us] * PULSES for one in joint.muscles])
    torn = even.copy()
    torn[0, 200] = 0.0
    lost = float(np.sum(play(joint, even) - play(joint, torn))) / 1600
    drive = joint.agonist.active_nm(even[0, :1], np.zeros(1))[0] * 0.025
    assert lost == pytest.approx(drive, rel=0.02)


def test_a_seed_decides_and_an_override_changes_nothing_else() -> None:
    assert draw_joint(9).truth == draw_joint(9).truth != draw_joint(10).truth
    drawn, asked = draw_joint(9).truth, draw_joint(9, cross_talk=0.0, co_contraction=0.25).truth
    assert (asked["cross_talk"], asked["co_contraction"]) == ([0.0, 0.0], pytest.approx(0.25))
    assert drawn["muscles"] == asked["muscles"]
    joint = draw_joint(9)
    one, same, other = (record(joint, *widths(joint), seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(one["torque_nm"], same["torque_nm"])
    assert np.array_equal(one["clean_nm"], other["clean_nm"]) and not np.array_equal(
        one["torque_nm"], other["torque_nm"]
    )
    assert np.std(one["torque_nm"] - one["clean_nm"]) == pytest.approx(0.05, rel=0.1)


def test_seeds_spread_as_stated() -> None:
    joints = [draw_joint(seed) for seed in range(100)]
    shares = np.array([joint.cross_talk for joint in joints])
    strength = np.array([joint.co_contraction for joint in joints])
    assert 35 <= np.count_nonzero(shares.max(axis=1) == 0.0) <= 65
    assert 35 <= np.count_nonzero(strength == 0.0) <= 65
    assert 0.25 < shares.max() <= 0.301 and 0.2 < strength.max() <= 0.25
    muscles = [one for joint in joints for one in joint.muscles]
    assert all(0.1 <= one.base.t_omega_s <= 0.5 and 2.9 < one.largest_nm < 15.1 for one in muscles)
    assert 25 <= sum(one.fatigue_depth > 0.0 for one in muscles) <= 75
    assert 5 <= sum(one.faster != 0.0 for one in muscles) <= 40


def test_a_muscle_tires_and_recovers() -> None:
    joint = draw_joint(11, cross_talk=0.0, co_contraction=0.0, plain=True)
    tiring = replace(joint, agonist=replace(joint.agonist, fatigue_depth=0.3, fatigue_s=20.0))
    top = joint.agonist.largest_width_us
    torque_nm = record(tiring, np.full(2400, top), np.zeros(2400), noise_sd_nm=0.0)["clean_nm"]
    assert torque_nm[-1] == pytest.approx(joint.agonist.largest_nm * (1 - 0.3 * (1 - np.exp(-3))), rel=0.01)
    assert torque_nm.max() > 1.15 * torque_nm[-1]


@pytest.mark.parametrize("given", [{"cross_talk": -0.1}, {"co_contraction": 0.9}])
def test_no_joint_out_of_bounds(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="give 0 to"):
        draw_joint(1, **given)


def test_no_record_of_unequal_channels_or_another_rate() -> None:
    with pytest.raises(ValueError, match="two rows of one length"):
        record(draw_joint(1), [100.0], [100.0, 200.0])
    with pytest.raises(ValueError, match="divisor"):
        record(draw_joint(1), [100.0], [100.0], rate_hz=300)
