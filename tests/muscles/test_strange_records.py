"""Records as arms give them, and records of muscles of other physics, have the properties they are made for."""

from __future__ import annotations

import numpy as np
import pytest

from bench.muscles.bout_records import RAMPS, record_of_bouts
from bench.muscles.physics_records import DISTURBED, NOISE_SD_NM, SETS, record_of_physics

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_readings_are_held_and_jump(seed: int) -> None:
    made = record_of_bouts(seed)
    changes = np.flatnonzero(np.diff(made["torque_nm"])) + 1
    read_hz = made["truth"]["rate_hz"] / np.mean(np.diff(changes))
    assert 18.0 < read_hz < 48.0
    assert np.median(np.abs(np.diff(made["torque_nm"], 3))) == 0.0
    assert 0.02 < np.std(made["clean_nm"]) < 1.1


def test_the_last_bout_is_weaker_in_some_records() -> None:
    drawn = [record_of_bouts(seed)["truth"]["muscle"]["weaker"] for seed in range(40)]
    assert 2 <= sum(one < 1.0 for one in drawn) <= 14


@pytest.mark.parametrize("seed", SEEDS)
def test_the_last_of_four_equal_ramps_is_unseen(seed: int) -> None:
    made = record_of_bouts(seed)
    last = int(made["bout"][-1])
    ramps = [made["pulse_width_us"][(made["bout"] == last - back)] for back in range(RAMPS)]
    short = min(map(len, ramps))
    assert all(np.array_equal(ramp[:short], ramps[0][:short]) for ramp in ramps)
    assert np.array_equal(made["segment"] == "validate", made["bout"] == last)
    assert {"twitch", "bout", "prbs", "ramp"} <= set(made["segment"])


def test_twitches_look_fast_and_ramps_slow() -> None:
    """The slow way is 2.7 times as slow as the quick one or slower, and either carries a third and more."""
    for seed in SEEDS:
        muscle = record_of_bouts(seed)["truth"]["muscle"]
        quick, slow = muscle["tau_s"]
        assert slow > 2.5 * quick
        assert min(muscle["shares"]) >= 0.35


def test_seeds_reproduce() -> None:
    for made, again, other in (
        [record_of_bouts(seed) for seed in (3, 3, 4)],
        [record_of_physics("physics", seed) for seed in (3, 3, 4)],
    ):
        assert np.array_equal(made["torque_nm"], again["torque_nm"])
        assert not np.array_equal(made["torque_nm"][:4000], other["torque_nm"][:4000])


@pytest.mark.parametrize("kinds", SETS)
def test_muscles_of_other_physics_are_finite_and_relax(kinds: str) -> None:
    for seed in range(max(len(SETS[kinds]), 1)):
        made = record_of_physics(kinds, seed, ())
        unseen = made["unseen"]
        assert np.isfinite(made["torque_nm"]).all()
        assert 46.0 < made["time_s"][-1] < 49.0
        assert 28.0 < made["time_s"][np.argmax(made["segment"] == "validate")] < 31.0
        assert 0.3 < np.max(unseen["torque_nm"]) < 20.0
        assert np.max(np.abs(unseen["torque_nm"][unseen["time_s"] < 1.9])) < 1e-6
        assert unseen["torque_nm"][-1] < 0.25 * np.max(unseen["torque_nm"])
        quiet = made["torque_nm"][made["time_s"] < 1.9]
        assert np.std(quiet) == pytest.approx(NOISE_SD_NM, rel=0.15)
        assert not np.array_equal(made["pulse_width_us"][: unseen["time_s"].size], unseen["pulse_width_us"])


@pytest.mark.parametrize("kind", DISTURBED)
def test_what_lies_over_a_record_is_not_in_the_unseen_one(kind: str) -> None:
    bare, over = (record_of_physics("plain", 0, chosen) for chosen in ((), (kind,)))
    added = over["torque_nm"] - bare["torque_nm"]
    assert 0.01 < np.std(added) < 0.4
    assert np.array_equal(over["unseen"]["torque_nm"], bare["unseen"]["torque_nm"])
    assert over["truth"]["disturbed"] == [kind]
