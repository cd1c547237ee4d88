"""The arm's physics: laws, signs, energy, stops, a pendulum's period, and whatever moves it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stimrig.hardware_sim import patients
from stimrig.hardware_sim.arm.laws import LAWS, StandardLinearSolid
from stimrig.hardware_sim.arm.limb import Arm, Limb, read_arm, set_laws
from stimrig.hardware_sim.arm.motion import Begin, Motion
from stimrig.hardware_sim.arm.movers import MOVERS, make_mover
from stimrig.hardware_sim.arm.tissue import REFERENCE_RAD, Mechanics, Tissue, bare, law
from stimrig.hardware_sim.errors import HardwareSimError

STEP_S = 1.0 / 1600.0
RANGE = np.radians(np.linspace(0.0, 140.0, 71))


class Constant:
    """A muscle with the same torque for ever."""

    def __init__(self, torque_nm: float = 0.0) -> None:
        self.level_nm = torque_nm

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        raise AssertionError((time_s, width_us, current_ma))

    def torque_nm(self, time_s: float) -> float:
        return self.level_nm + 0.0 * time_s


def rows(limb: Limb, seconds: float, begin_s: float = 0.0) -> np.ndarray:
    """Torque at the cell, angle, velocity, acceleration at 1600 Hz."""
    times_s = begin_s + STEP_S * np.arange(1, round(seconds / STEP_S))
    return np.array([[limb.torque_nm(float(time_s)), *limb.motion] for time_s in times_s])


def heavy(**mechanics: Any) -> Tissue:
    """A pendulum without any loss."""
    return replace(bare(), mechanics=Mechanics(**{"inertia_kg_m2": 0.07, **mechanics}))


class TestLaws:
    def test_stops_push_back_and_never_pull(self) -> None:
        mechanics = Mechanics()
        assert mechanics.stops_nm(math.radians(150.0), 0.0) == pytest.approx(-200.0 * math.radians(5.0))
        assert np.all(mechanics.stops_nm(math.radians(150.0), np.linspace(-50.0, 50.0, 101)) <= 0.0)
        assert np.all(mechanics.stops_nm(math.radians(-7.0), np.linspace(-50.0, 50.0, 101)) >= 0.0)
        assert mechanics.stops_nm(1.5, 5.0) == 0.0

    @pytest.mark.parametrize("name", LAWS["passive"])
    def test_tissue_pushes_back_from_both_ends_and_never_gives_energy(self, name: str) -> None:
        passive = law("passive", name)
        still = passive.torque_nm(RANGE, 0.0)
        assert still.shape == RANGE.shape
        assert np.all(np.diff(still) <= 1e-12)
        if name != "none":
            assert still[0] > 0.5 > -0.5 > still[-1]
        turn = np.linspace(0.0, 2.0 * math.pi, 4001)
        angle, velocity = 1.2 + 0.8 * np.sin(turn), 0.8 * np.cos(turn)
        work_j = np.trapezoid(passive.torque_nm(angle, velocity) * velocity, turn)
        assert work_j <= 1e-9
        assert work_j < -0.01 or name == "none"

    @pytest.mark.parametrize("name", LAWS["torque_angle"])
    def test_a_share_is_positive_and_has_one_best_angle(self, name: str) -> None:
        share = law("torque_angle", name).share(RANGE)
        assert np.all((share > 0.0) & (share <= 1.1))
        rising = np.diff(share)[np.abs(np.diff(share)) > 1e-12] > 0
        assert np.count_nonzero(rising[1:] != rising[:-1]) <= 1
        assert Tissue(torque_angle=law("torque_angle", name)).g(REFERENCE_RAD, 0.0) == pytest.approx(1.0)

    @pytest.mark.parametrize("name", LAWS["torque_velocity"])
    def test_a_muscle_that_shortens_gives_less_and_one_that_is_stretched_more(self, name: str) -> None:
        velocity = np.linspace(-8.0, 20.0, 400)
        share = law("torque_velocity", name).share(np.full(400, REFERENCE_RAD), velocity)
        assert law("torque_velocity", name).share(REFERENCE_RAD, 0.0) == pytest.approx(1.0)
        assert np.all(np.diff(share) <= 1e-12)
        assert np.all((share >= 0.0) & (share < 2.0))
        assert (share[0] > 1.1 and share[-1] < 0.3) or name == "none"

    def test_numbers_of_the_papers(self) -> None:
        hill = law("torque_velocity", "hill", {"largest_rad_s": 10.0, "curvature": 0.25, "plateau": 1.5})
        assert hill.share(1.0, 5.0) == pytest.approx(0.5 / 3.0)
        assert hill.share(1.0, 10.0) == 0.0
        assert hill.share(1.0, -1e9) == pytest.approx(1.5)
        fibre = law(
            "passive", "fibre_exponential", {"extensor_nm": 0.0, "flexor_slack_rad": 1.3, "viscosity_nm_s": 0.0}
        )
        assert fibre.torque_nm(1.3 - 0.6 / 0.5, 0.0) == pytest.approx(6.0), "one at a stretch of 0.6 lengths"
        parabola = law("torque_angle", "parabola", {"linear_per_deg": 0.0344, "quadratic_per_deg2": 4.49e-4})
        assert parabola.share(math.radians(70.0)) == pytest.approx(1.0 + 0.0344 * 20 - 4.49e-4 * 400)
        thelen = law("torque_angle", "force_length", {"best_rad": 1.0, "lengths_per_rad": 0.5, "gamma": 0.45})
        assert thelen.share(2.0) == pytest.approx(math.exp(-0.25 / 0.45))

    def test_a_solid_relaxes_with_its_time_constant(self) -> None:
        solid = StandardLinearSolid(stiffness_nm_per_rad=2.0, lasting_share=0.5, relaxation_s=1.0, viscosity_nm_s=0.0)
        memory = solid.begin(1.0)
        for _ in range(1600):
            memory = solid.step(memory, 1.5, STEP_S)
        assert solid.remembered_nm(memory, 1.5) == pytest.approx(-0.5 * math.exp(-1.0), rel=1e-9)

    @pytest.mark.parametrize(
        ("asked", "told"),
        [
            (("colour", "red"), "no laws of 'colour'"),
            (("passive", "jelly"), "unknown law of passive 'jelly'"),
            (("passive", "none", {"mass": 1.0}), "has no parameter 'mass'"),
            (("passive", "linear_friction", {"dry_nm": math.nan}), "must be a finite number"),
            (("torque_velocity", "hill", {"largest_rad_s": 0.0}), "'largest_rad_s' of law hill .* must be above 0"),
            (("torque_velocity", "hill", {"plateau": 1.0}), "'plateau' of law hill of torque_velocity must be above 1"),
            (("torque_angle", "force_length", {"gamma": -0.1}), "'gamma' of law force_length .* must be above 0"),
            (("passive", "standard_linear_solid", {"relaxation_s": 0}), "'relaxation_s' .* must be above 0"),
        ],
    )
    def test_a_law_that_is_not_there_is_told(self, asked: tuple[Any, ...], told: str) -> None:
        with pytest.raises(HardwareSimError, match=told):
            law(*asked)


class TestWhatTheCellMeasures:
    def test_at_the_reference_angle_it_is_the_muscles_torque_and_passive_torque(self) -> None:
        limb = Limb(Constant(5.0), Arm())
        assert limb.torque_nm(1.0) == pytest.approx(5.0 + Tissue().h_nm(REFERENCE_RAD, 0.0))

    def test_gravity_pulls_the_horizontal_forearm_into_extension(self) -> None:
        cases = ((0, 90, -2.8), (0, 0, 0.0), (90, 0, -2.8), (90, 90, 0.0), (0, 30, -1.4))
        for upper_arm_deg, angle_deg, wanted in cases:
            arm = Arm("held", {"angle_deg": angle_deg}, heavy(weight_nm=2.8, upper_arm_deg=upper_arm_deg))
            assert Limb(Constant(), arm).torque_nm(1.0) == pytest.approx(wanted, abs=1e-9)

    def test_a_forearm_that_is_speeded_up_pulls_the_other_way(self) -> None:
        limb = Limb(Constant(), Arm("robot", {"from_deg": 90, "to_deg": 120}, heavy()))
        found = rows(limb, 1.5)
        assert np.abs(found[:, 3]).max() > 1.0
        assert found[:, 0] == pytest.approx(-0.07 * found[:, 3], abs=1e-12)

    def test_active_torque_follows_g_and_not_the_isometric_torque(self) -> None:
        tissue = replace(Tissue(passive=law("passive", "none")), mechanics=Mechanics(inertia_kg_m2=0.0))
        limb = Limb(Constant(6.0), Arm("robot", {"from_deg": 40, "to_deg": 120, "deg_s": 80}, tissue))
        found = rows(limb, 4.0)
        assert found[:, 0] == pytest.approx(6.0 * tissue.g(found[:, 1], found[:, 2]))
        slow = np.abs(found[:, 1] - 1.4) < 0.05
        assert np.ptp(found[slow, 0]) > 0.5, "at one angle, less while it flexes than while it extends"

    def test_the_real_muscle_behind_it_gets_the_pulses(self) -> None:
        alone, limb = patients.make("paper"), Limb(patients.make("paper"), Arm(tissue=bare()))
        for k in range(40):
            for muscle in (alone, limb):
                muscle.pulse(0.025 * k, 200.0, 20.0)
        assert limb.torque_nm(1.0) == pytest.approx(alone.torque_nm(1.0), rel=1e-9)


class TestMovers:
    @pytest.mark.slow
    def test_angle_velocity_and_acceleration_belong_together_whatever_is_asked_of_it(self) -> None:
        """Also where one mover takes over from another in full movement: no jump of angle or velocity."""
        limb, rng = Limb(Constant(1.0), Arm(), seed=4), np.random.default_rng(3)
        asked: list[tuple[str, dict[str, Any]]] = [
            ("robot", {"from_deg": 20, "to_deg": 130, "deg_s": 120}),
            ("hand", {"from_deg": 110, "to_deg": 40, "deg_s": 60}),
            ("held", {}),
            ("waves", {"hz": [0.2, 0.3], "deg": [20, 10], "phase_rad": [0.3, 2.0]}),
            ("held", {"angle_deg": 70}),
            ("hand", {}),
        ]
        found = []
        for mode, settings in asked:
            limb.move(mode, settings, limb._time_s)
            found.append(rows(limb, float(rng.uniform(0.7, 2.0)), limb._time_s))
        angle, velocity = np.concatenate(found)[:, 1:3].T
        between = np.diff(angle) / STEP_S
        assert np.abs(between - 0.5 * (velocity[1:] + velocity[:-1])).max() < 0.01
        assert np.abs(np.diff(velocity)).max() < 0.35, "the fastest servo's acceleration in one step"
        assert np.all(np.degrees(angle) > -10.0) and np.all(np.degrees(angle) < 160.0)

    @pytest.mark.parametrize("mode", MOVERS)
    def test_the_movement_does_not_depend_on_when_it_is_looked_at(self, mode: str) -> None:
        settings = {"held": {"angle_deg": 40}}.get(mode, {})
        begin = Begin(0.0, Motion(1.2), seed=5)
        often, seldom = make_mover(mode, begin, settings), make_mover(mode, begin, settings)
        for k in range(1, 3001):
            seen = often(0.001 * k)
            if k % 377 == 0:
                assert seldom(0.001 * k) == pytest.approx(seen)

    def test_a_robot_keeps_its_limit_and_comes_to_rest_between(self) -> None:
        robot = {"from_deg": 30, "to_deg": 120, "deg_s": 800, "pause_s": 2.5}
        found = rows(Limb(Constant(), Arm("robot", robot)), 12.0)
        assert np.degrees(np.abs(found[:, 2]).max()) == pytest.approx(180.0, rel=1e-6)
        assert np.degrees(found[:, 1].min()) == pytest.approx(30.0, abs=1.0)
        assert np.degrees(found[:, 1].max()) == pytest.approx(120.0, abs=1.0)

    @pytest.mark.slow
    def test_a_hand_that_holds_still_wanders_and_trembles_and_no_two_sweeps_are_alike(self) -> None:
        found = rows(Limb(Constant(), Arm("hand", {}, heavy()), 3), 10.0)[3200:]
        assert 0.1 < np.degrees(np.std(found[:, 1])) < 1.2
        spectrum = np.abs(np.fft.rfft(found[:, 0] * np.hanning(found.shape[0])))
        hz = np.fft.rfftfreq(found.shape[0], STEP_S)
        assert spectrum[(hz > 7.0) & (hz < 13.0)].max() > 20.0 * np.median(spectrum[(hz > 3.0) & (hz < 7.0)])
        sweep = {"from_deg": 40, "to_deg": 110, "deg_s": 40}
        first, again, other = (rows(Limb(Constant(), Arm("hand", sweep, heavy()), seed), 2.0) for seed in (1, 1, 2))
        assert np.array_equal(first, again) and not np.allclose(first, other)

    @pytest.mark.parametrize(
        ("mode", "settings", "told"),
        [
            ("fly", {}, "unknown mode of the arm 'fly'; there are hand, held, robot, waves"),
            ("held", {"angle": 3}, "no setting 'angle'; it has angle_deg, deg_s"),
            ("held", {"angle_deg": 161}, "'angle_deg' must be between -10 and 160"),
            ("held", {"angle_deg": math.inf}, "'angle_deg' must be between -10 and 160"),
            ("robot", {"deg_s": 0}, "'deg_s' must be between"),
            ("waves", {"hz": [1.0], "deg": [1.0, 2.0]}, "equally long"),
            ("waves", {"hz": 3}, "lists of numbers"),
        ],
    )
    def test_nonsense_is_told_and_it_goes_on_as_before(self, mode: str, settings: dict[str, Any], told: str) -> None:
        limb = Limb(Constant(), Arm("robot"))
        with pytest.raises(HardwareSimError, match=told):
            limb.move(mode, settings)
        assert limb.mode == "robot"


def test_the_command_lines_arm() -> None:
    arm = read_arm("robot,from_deg=50")
    assert (arm.mode, arm.movement, arm.start_deg) == ("robot", {"from_deg": 50.0}, 50.0)
    other = set_laws(arm, ["passive=linear_friction,dry_nm=0.3", "mechanics=forearm,weight_nm=2.5"])
    assert other.tissue.mechanics.weight_nm == 2.5
    assert other.tissue.passive == law("passive", "linear_friction", {"dry_nm": 0.3})
    assert other.tissue.torque_angle == Tissue().torque_angle
