"""Offline records of an arm: they hold what their truth says, and what a rig would have measured of it."""

from __future__ import annotations

import numpy as np
import pytest

from bench.muscles.arm_records import KINDS, arm_patient, changed, record

pytestmark = pytest.mark.slow

KIND_NAMES = tuple(KINDS)
COLUMNS = {"time_s", "pulse_width_us", "torque_nm", "angle_rad", "velocity_rad_s", "segment"}


@pytest.mark.parametrize("seed", range(0, 40, 5))
def test_g_is_one_where_the_muscle_is_described_and_everything_is_finite(seed: int) -> None:
    patient = arm_patient(seed)
    assert patient.g(patient.reference_rad, 0.0) == pytest.approx(1.0)
    angle, velocity = np.meshgrid(np.linspace(*patient.range_rad, 30), np.linspace(-3.0, 3.0, 31))
    g, h = patient.g(angle, velocity), patient.h_nm(angle, velocity)
    assert g.shape == h.shape == angle.shape
    assert np.all(g[15] >= 0.15) and np.all(g[15] <= 2.0)
    assert np.all((g >= 0.0) & (g < 4.0))
    assert np.all(np.abs(h) < 40.0)
    assert np.all(np.diff(g, axis=0) <= 1e-12), "a flexor that shortens faster gives less torque"
    assert np.all(np.diff(h, axis=0) < 0.0), "viscosity takes torque from whatever moves"


def test_the_seeds_differ_widely() -> None:
    drawn = [arm_patient(seed).truth for seed in range(60)]
    for place, fewest in {"passive": 4, "torque_angle": 4, "torque_velocity": 4}.items():
        assert len({each[place]["law"] for each in drawn}) >= fewest
    assert 0.25 < np.mean([each["mechanics"]["weight_nm"] > 0.0 for each in drawn]) < 0.55
    assert arm_patient(3).truth == arm_patient(3).truth


@pytest.mark.parametrize("kind", KIND_NAMES)
def test_a_record_is_its_truth_and_white_noise(kind: str) -> None:
    patient = arm_patient(4)
    made = record(patient, kind, 7)
    truth = made["truth"]
    assert set(made) >= COLUMNS
    assert len({made[name].size for name in COLUMNS}) == 1
    assert np.diff(made["time_s"]) == pytest.approx(1 / 400)
    noise = made["torque_nm"] - truth["torque_nm"]
    assert noise.std() == pytest.approx(truth["noise_sd_nm"], rel=0.05)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.05


def test_the_seed_settles_a_record() -> None:
    one, again, other = (record(arm_patient(4), "held", seed)["torque_nm"] for seed in (7, 7, 8))
    assert np.array_equal(one, again) and not np.array_equal(one, other)


@pytest.mark.parametrize("kind", KIND_NAMES)
def test_the_torque_is_the_contracts_equation(kind: str) -> None:
    patient = next(each for each in map(arm_patient, range(50)) if "solid" not in each.truth["passive"]["law"])
    truth = record(patient, kind, 2)["truth"]
    angle, velocity, acceleration = (truth[name] for name in ("angle_rad", "velocity_rad_s", "acceleration_rad_s2"))
    active = patient.g(angle, velocity) * truth["isometric_nm"]
    wanted = active + patient.h_nm(angle, velocity) - patient.inertia_kg_m2 * acceleration
    assert truth["torque_nm"] == pytest.approx(wanted, abs=1e-9)


def test_isometric_torque_settles_at_the_recruitment_curve() -> None:
    patient = arm_patient(9)
    width = np.full(16_000, 0.7 * patient.largest_width_us)
    assert patient.isometric_nm(width, 1 / 1600)[-1] == pytest.approx(patient.recruitment_nm(width[-1]), rel=1e-6)
    assert patient.recruitment_nm(patient.largest_width_us) == pytest.approx(patient.base.largest_nm)
    assert patient.recruitment_nm(0.0) == 0.0


def test_tissue_with_memory_comes_back_to_h() -> None:
    patient = next(each for each in map(arm_patient, range(50)) if "solid" in each.truth["passive"]["law"])
    angle = np.r_[np.full(10, 1.0), np.full(60_000, 1.3)]
    memory = patient.remembered_nm(angle, 1 / 1600)
    assert memory[5] == 0.0
    assert memory[12] < -0.01
    assert abs(memory[-1]) < 1e-3


def test_what_each_kind_is_for() -> None:
    patient = arm_patient(5)
    passive, moving, unseen = (record(patient, kind, 1) for kind in ("passive", "moving", "unseen"))
    assert not passive["pulse_width_us"].any()
    low, high = patient.range_rad
    for made in (passive, moving, unseen):
        covered = made["angle_rad"].min(), made["angle_rad"].max()
        assert covered == pytest.approx((low, high), abs=np.radians(9.0))
    thirds = np.array_split(np.abs(passive["truth"]["velocity_rad_s"]), 3)
    assert np.percentile(thirds[0], 90) < 0.5 * np.percentile(thirds[2], 90)
    assert len(np.unique(moving["pulse_width_us"])) > 5
    assert set(unseen["segment"]) == {"rest", "validate"}
    assert unseen["pulse_width_us"].max() <= patient.largest_width_us


def test_held_records_stay_where_they_were_asked_for() -> None:
    patient = arm_patient(6)
    for at_rad in (patient.range_rad[0] + 0.05, patient.reference_rad, patient.range_rad[1] - 0.05):
        made = record(patient, "held", 3, angle_rad=float(at_rad))
        assert np.abs(made["angle_rad"] - at_rad).max() < 0.06
        assert made["pulse_width_us"].max() == patient.largest_width_us
    prbs = record(patient, "isometric", 3)
    assert list(dict.fromkeys(prbs["segment"])) == ["rest", "prbs", "ramp"]


def test_angles_are_those_of_the_encoder_and_velocities_those_of_the_rig() -> None:
    made = record(arm_patient(7), "unseen", 1)
    truth = made["truth"]
    off_deg = np.degrees(made["angle_rad"] - truth["angle_rad"])
    assert 0.015 < off_deg.std() < 0.03
    middle = slice(200, -200)
    off_rad_s = (made["velocity_rad_s"] - truth["velocity_rad_s"])[middle]
    assert off_rad_s.std() < 0.012
    assert abs(off_rad_s.mean()) < 0.001, "centred: no delay that a movement to and fro would show"


def test_another_recorder_changes_what_it_says_and_no_more() -> None:
    made = record(arm_patient(8), "held", 1)
    other = changed(made, scale=-2.0, offset_nm=3.0, start_s=1.5, time_shift_s=100.0, angle_error_rad=0.02)
    assert other["time_s"][0] == pytest.approx(100.0)
    assert other["torque_nm"] == pytest.approx(3.0 - 2.0 * made["torque_nm"][600:])
    assert other["angle_rad"] == pytest.approx(made["angle_rad"][600:] + 0.02)
    assert other["truth"]["torque_nm"].size == other["torque_nm"].size
    assert made["time_s"][0] == 0.0


def test_nonsense_is_told() -> None:
    with pytest.raises(ValueError, match="kind 'wild': one of isometric"):
        record(arm_patient(0), "wild", 0)
