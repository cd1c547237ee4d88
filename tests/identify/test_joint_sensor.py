"""A joint whose sensor errs: noise, steps, delay, gaps; what the angle alone says of velocity and acceleration."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench.muscles.arm_patient import arm_patient
from bench.muscles.arm_records import ENCODER, AngleSensor, record
from stimrig import identify
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.candidates import SLOW, trusted
from stimrig.identify.estimation.effect_fit import fitted_with
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.fitting import MOVING_JOINT
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import predict
from stimrig.identify.problem.pulses import motion_of
from stimrig.identify.records.join import join
from stimrig.identify.records.joint_motion import STEADY, JointMotion, smooth
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

ARM = 5
NOISY, STEPPED, LATE = AngleSensor(noise_deg=0.3), AngleSensor(step_deg=0.35), AngleSensor(delay_s=0.02)
RATE_HZ, MOVES_S = 200.0, 20.0


def moved(rate_hz: float = RATE_HZ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, true angles and true velocities of a movement that is never still."""
    time_s = np.arange(0.0, MOVES_S, 1.0 / rate_hz)
    angle = 1.2 + 0.4 * np.sin(1.7 * time_s) + 0.15 * np.sin(4.1 * time_s + 1.0)
    return time_s, angle, 0.68 * np.cos(1.7 * time_s) + 0.615 * np.cos(4.1 * time_s + 1.0)


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error[20:-20] ** 2)))


def test_the_velocity_of_a_noisy_angle_is_found_much_better_than_by_its_slope():
    time_s, angle, velocity = moved()
    read = angle + np.radians(0.3) * np.random.default_rng(0).normal(size=angle.size)
    found = JointMotion.of(time_s, read)
    assert rms(found.velocity_rad_s - velocity) < 0.03 * rms(np.gradient(read, time_s) - velocity)
    assert rms(found.angle_rad - angle) < 0.25 * rms(read - angle)
    assert found.noise_rad[0] == pytest.approx(np.radians(0.3), rel=0.1)
    assert found.step_rad == 0.0


def test_with_an_earlier_trial_nothing_later_is_looked_at():
    unseen, earlier = (
        as_record(record(arm_patient(ARM), "reaching", seed, duration_s=12.0, sensor=NOISY)) for seed in (7, 8)
    )
    assert unseen.angle_rad is not None
    row, interval = unseen.angle_rad.size // 2 + 5, round(unseen.sample_rate_hz / unseen.pulse_rate_hz)
    turned = np.r_[unseen.angle_rad[:row], 2.0 * unseen.angle_rad[row - 1] - unseen.angle_rad[row:]]
    own, other = (predict(clean(), one, earlier) for one in (unseen, replace(unseen, angle_rad=turned)))
    begin = row - row % interval
    assert np.array_equal(own[:begin], other[:begin]) and not np.array_equal(own[begin:], other[begin:])
    noise = np.random.default_rng(0).normal(size=earlier.time_s.size)
    for still in (np.full_like(noise, 1.2), 1.2 + 0.003 * noise, np.where(noise > 2.0, earlier.angle_rad, np.nan)):
        with pytest.raises(BadRequest, match="no joint moves"):
            predict(clean(), unseen, replace(earlier, angle_rad=still))
    with pytest.raises(BadRequest, match="several recordings"):
        predict(clean(), unseen, recorded_by(NOISY))


@pytest.mark.parametrize("comes_and_goes", [True, False])
def test_what_a_movement_does_in_general_helps_the_causal_filter_where_it_comes_and_goes(comes_and_goes: bool):
    time_s, angle, velocity = moved()
    if not comes_and_goes:
        share = np.clip((time_s - 8.0) / 2.0, 0.0, 1.0)
        angle = 0.5 + share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        velocity = np.gradient(angle, time_s)
    read = angle + np.radians(0.3) * np.random.default_rng(2).normal(size=angle.size)
    both = JointMotion.of(time_s, read)
    usual = smooth(time_s, read, both.noise_rad[0], both.jerk[0], STEADY)
    before = np.roll(angle, 1700) if comes_and_goes else np.interp(time_s - 3.0, time_s, angle)
    before += np.radians(0.3) * np.random.default_rng(5).normal(size=angle.size)
    told = slice(1700, None) if comes_and_goes else slice(None)  # not where its end meets its begin
    paced = JointMotion.until_then(time_s, read, [0], (time_s[told], before[told]))
    errors = [rms(found - velocity) for found in (paced.velocity_rad_s, usual[:, 1])]
    assert errors[0] < (0.85 if comes_and_goes else 1.05) * errors[1]


def test_a_late_angle_is_told_ahead():
    time_s, angle, velocity = moved()
    late_s = 0.02
    read = np.interp(time_s - late_s, time_s, angle)
    now = JointMotion.until_then(time_s, read, [0], (time_s, read)).extrapolated(late_s)
    settled = time_s > 1.0
    assert rms((now.angle_rad - angle)[settled]) < 0.1 * rms((read - angle)[settled])
    slope = np.gradient(read, time_s)
    assert rms((now.velocity_rad_s - velocity)[settled]) < 0.3 * rms((slope - velocity)[settled])


def test_steps_are_seen_and_an_angle_that_rests_on_them_does_not_move():
    step = np.radians(0.35)
    time_s, angle, velocity = moved()
    found = JointMotion.of(time_s, np.round(angle / step) * step)
    assert found.step_rad == pytest.approx(step, rel=1e-6)
    assert rms(found.angle_rad - angle) < 0.4 * step / np.sqrt(12.0)
    assert rms(found.velocity_rad_s - velocity) < 0.03
    creeps = 1.2 + 0.3 * step * np.sin(time_s)  # over the edge between two steps, again and again
    both = np.r_[np.round(angle / step) * step, np.round(creeps / step) * step]
    parts = JointMotion.of(np.r_[time_s, time_s + MOVES_S], both, [0, time_s.size])
    assert np.max(np.abs(parts.velocity_rad_s[time_s.size :])) < 0.002


def test_readings_that_are_missing_late_or_uneven_are_bridged():
    rng = np.random.default_rng(2)
    time_s, angle, velocity = moved()
    time_s = time_s + rng.uniform(-0.001, 0.001, time_s.size)
    angle = np.interp(time_s, *moved()[:2])
    velocity = np.interp(time_s, moved()[0], velocity)
    read = angle + 0.002 * rng.normal(size=angle.size)
    read[1000:1016] = np.nan
    kept = np.ones(read.size, bool)
    kept[2000:2016] = False
    found = JointMotion.of(time_s[kept], read[kept])
    assert np.isfinite(found.velocity_rad_s).all()
    assert rms(found.velocity_rad_s - velocity[kept]) < 0.05
    assert np.max(np.abs(found.angle_rad - angle[kept])[900:2100]) < 0.01


def test_angles_of_a_trial_are_smoothed_and_a_plan_stays_as_it_is():
    _, angle, velocity = moved(40.0)
    planned = motion_of(angle, 40.0)
    assert rms(planned.angle_rad - angle) < 1e-5 and rms(planned.velocity_rad_s - velocity) < 0.005
    read = angle + np.radians(0.3) * np.random.default_rng(4).normal(size=angle.size)
    assert rms(motion_of(read, 40.0).velocity_rad_s - velocity) < 0.2 * rms(np.gradient(read, 1 / 40) - velocity)


@cache
def recorded_by(sensor: AngleSensor) -> Record:
    """An isometric test, a passive and a moving one, joined."""
    arm = arm_patient(ARM)
    made = [record(arm, "isometric", 1, sensor=sensor), record(arm, "passive", 1, duration_s=24.0, sensor=sensor)]
    made.append(record(arm, "moving", 1, duration_s=20.0, sensor=sensor))
    return join([as_record(one) for one in made], [0.0, 120.0, 240.0])


@cache
def clean() -> Model:
    return identify.fit(recorded_by(ENCODER), effects=MOVING_JOINT)


@cache
def late() -> Model:
    return identify.fit(recorded_by(LATE), effects=MOVING_JOINT)


@cache
def noisy() -> Model:
    return identify.fit(recorded_by(NOISY), effects=MOVING_JOINT)


def unseen_over_noise(model: Model, sensor: AngleSensor) -> float:
    unseen = record(arm_patient(ARM), "unseen", 7, duration_s=20.0, sensor=sensor)
    error_nm = unseen["torque_nm"] - predict(model, as_record(unseen))
    return float(np.std(error_nm)) / unseen["truth"]["noise_sd_nm"]


def test_a_record_tells_by_how_much_its_angle_is_late():
    assert late().data["joint_sensor"]["delay_s"] == pytest.approx(0.02, abs=0.003)
    assert abs(clean().data["joint_sensor"]["delay_s"]) < 0.003
    told_ms = [int(found[1]) for reason in late().reasons if (found := re.search(r"angle (\d+) ms late", reason))]
    assert len(told_ms) == 1 and abs(told_ms[0] - 20) <= 3
    assert unseen_over_noise(late(), LATE) < 1.3


def test_a_noisy_angle_costs_little_and_the_model_says_how_much():
    told = noisy().data["joint_sensor"]
    assert told["noise_rad"] == pytest.approx(np.radians(0.25), rel=0.15)
    assert 0.0 < clean().data["joint_sensor"]["cost_nm"] < told["cost_nm"] < 0.1
    assert unseen_over_noise(noisy(), NOISY) < 1.3
    assert unseen_over_noise(clean(), NOISY) < 1.5 * unseen_over_noise(clean(), ENCODER)
    assert any("strays by 0.2" in reason for reason in noisy().reasons)
    assert Model.from_json(noisy().to_json()).data["joint_sensor"] == told


def test_slow_noise_that_holds_what_the_structure_leaves_is_left_for_the_likelier_optimum():
    fitted = fitted_with(as_record(record(arm_patient(ARM), "isometric", 1)), ["passive_torque:linear"])
    assert trusted(fitted) is fitted
    wrong = replace(fitted, noise=replace(fitted.noise, ar1=0.99, share=0.9), log_evidence=fitted.log_evidence - 50.0)
    again = trusted(wrong)
    assert isinstance(again, Fitted) and not (again.noise.ar1 > SLOW and again.noise.share > 0.05)
    assert again.log_evidence > wrong.log_evidence


def test_the_velocity_follows_from_the_angle_and_needs_no_column():
    made = recorded_by(ENCODER)
    alone = replace(made, velocity_rad_s=None)
    assert np.array_equal(predict(clean(), alone), predict(clean(), made))
    assert alone.knows("velocity_rad_s") and not replace(alone, angle_rad=None).knows("velocity_rad_s")
