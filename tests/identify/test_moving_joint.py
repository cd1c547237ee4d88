"""f, G, g and h from joined records of a joint that moves; the arms' physics is the emulator's, not the library's."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from bench.muscles.arm_patient import ArmPatient, arm_patient
from bench.muscles.arm_records import changed, record
from stimrig import identify
from stimrig.identify.diagnosis.search import search_effects
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.effects.passive_torque import relaxed
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.estimation.effect_fit import add_effects, fitted_with
from stimrig.identify.estimation.plain import renewed_curve
from stimrig.identify.estimation.quality import quality, range_warnings
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.fitting import MOVING_JOINT
from stimrig.identify.inversion import Reference, invert
from stimrig.identify.methods.maximum_likelihood import start
from stimrig.identify.model import Model
from stimrig.identify.problem.joint_surface import Surfaces
from stimrig.identify.problem.pulses import above_rest, motion_of
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record

pytestmark = pytest.mark.slow

ARM = 12
"""Tissue that relaxes, a Hill muscle, moment arm and fibre length: one of the development arms."""


@cache
def recorded_tests() -> tuple[dict[str, Any], ...]:
    arm = arm_patient(ARM)
    held = record(arm, "held", 1, angle_rad=float(np.mean(arm.range_rad)))
    return (
        record(arm, "isometric", 1),
        record(arm, "passive", 1, duration_s=36.0),
        held,
        record(arm, "moving", 1, duration_s=30.0),
    )


def joined(made: Any, order: Any = None) -> Record:
    begins = [120.0 * place for place in range(len(made))]
    places = list(order or range(len(made)))
    return join([as_record(made[place]) for place in places], [begins[place] for place in places])


@cache
def model() -> Model:
    return identify.fit(joined(recorded_tests()), effects=MOVING_JOINT)


def surfaces(of: Model) -> Surfaces:
    found = Surfaces.of(of.effects)
    assert found is not None
    return found


def seen(of: Model, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Angles and velocities of the cells that were seen."""
    x, v = np.meshgrid(of.joint["angle_rad"], of.joint["velocity_rad_s"], indexing="ij")
    rows = np.asarray(of.joint[f"seen_{name}"]) > 0
    return x[rows], v[rows]


def test_a_joint_that_moved_in_a_test_at_rest_is_told():
    isometric, swept = recorded_tests()[0], recorded_tests()[-1]
    found, grid = identify.fit(as_record(swept)), make_grid(as_record(swept))
    held = identify.fit(as_record(isometric)).quality["gates"]["joint"]
    assert held["passed"], "it has an angle, and that does not move"
    blind = found.quality["gates"]["joint"]
    moved = math.degrees(np.ptp(swept["angle_rad"]))
    assert not blind["passed"] and blind["severity"] == "care"
    assert f"moved by {moved:.0f}°" in blind["says"] and "add what depends on the joint" in blind["says"]
    assert model().quality["gates"]["joint"]["passed"], "with g and h it may move"
    for times, passed in ((1.29, True), (1.31, False)):
        error = {"rms_nm": times * found.noise.white_sd_nm, "held_out_fit_percent": None}
        again = quality(found.with_(fit=found.fit | error), grid, grid.fitted)
        assert again["gates"]["joint"]["passed"] == passed, "an error within the noise leaves nothing to tell"


def test_a_joint_that_did_not_move_says_nothing_of_g_and_h():
    gate = identify.fit(as_record(recorded_tests()[0]), effects=("torque_angle",)).quality["gates"]["joint_seen"]
    assert not gate["passed"] and gate["severity"] == "care" and "° only" in gate["says"]
    assert model().quality["gates"]["joint_seen"]["passed"]


def test_g_and_h_are_found_beside_f_and_dynamics():
    arm, found = arm_patient(ARM), surfaces(model())
    home = found.reference_rad
    x, v = seen(model(), "h")
    true_h = arm.h_nm(x, v) - arm.h_nm(home, 0.0)
    assert np.sqrt(np.mean((found.h_nm(x, v) - true_h) ** 2)) < 0.05 * np.ptp(true_h)
    x, v = seen(model(), "g")
    assert np.sqrt(np.mean((found.g(x, v) - arm.g(x, v) / arm.g(home, 0.0)) ** 2)) < 0.07
    width_us = np.linspace(0.0, arm.largest_width_us, 81)
    true_f = arm.recruitment_nm(width_us) * arm.g(home, 0.0)
    assert np.sqrt(np.mean((model().recruitment(width_us) - true_f) ** 2)) < 0.03 * true_f.max()
    assert -found.inertia_nm_s2_per_rad == pytest.approx(arm.inertia_kg_m2, rel=0.1)


def test_an_unseen_movement_is_predicted_to_the_noise():
    unseen = record(arm_patient(ARM), "unseen", 7, duration_s=20.0)
    error_nm = unseen["torque_nm"] - model().predict(as_record(unseen))
    error_nm -= np.median(error_nm)
    assert np.sqrt(np.mean(error_nm**2)) < 1.3 * unseen["truth"]["noise_sd_nm"]


def test_at_its_own_angle_where_most_was_stimulated_at_rest_g_is_one_and_h_is_zero():
    """Not where the record begins: the passive test, put first, begins elsewhere."""
    home = np.array([surfaces(model()).reference_rad])
    assert home == pytest.approx(arm_patient(ARM).reference_rad, abs=0.05)
    assert surfaces(model()).g(home, 0 * home) == pytest.approx(1.0)
    assert surfaces(model()).h_nm(home, 0 * home) == pytest.approx(0.0, abs=1e-9)
    assert any("chosen again" in reason for reason in model().reasons), "of the curve"


def test_another_scale_zero_and_start_of_the_cell_change_nothing():
    scale = -2.0
    tests = [changed(made, scale=scale, offset_nm=-7.0, start_s=1.3) for made in recorded_tests()]
    forms = [f"{entry['id']}:{entry['form']}" for entry in model().effects]
    other = surfaces(identify.fit(joined(tests), effects=forms))
    x, v = seen(model(), "h")
    h = surfaces(model()).h_nm(x, v)
    assert np.max(np.abs(other.h_nm(x, v) / scale - h)) < 0.03 * np.ptp(h)
    x, v = seen(model(), "g")
    assert np.max(np.abs(other.g(x, v) - surfaces(model()).g(x, v))) < 0.03
    assert other.inertia_nm_s2_per_rad / scale == pytest.approx(surfaces(model()).inertia_nm_s2_per_rad, rel=0.05)


def test_a_model_of_the_joint_refuses_to_predict_without_an_angle():
    made = as_record(recorded_tests()[0])
    with pytest.raises(BadModel, match="angle_rad"):
        model().predict(replace(made, angle_rad=None, velocity_rad_s=None))
    with pytest.raises(BadModel, match="depends on the angle"):
        above_rest(model(), np.full(40, 200.0), 40.0)


def test_model_json_holds_both_surfaces():
    again = Model.from_json(model().to_json())
    assert again.joint["g"] == model().to_dict()["joint"]["g"]
    rows, columns = len(again.joint["angle_rad"]), len(again.joint["velocity_rad_s"])
    for name in ("g", "h_nm", "g_lower", "g_upper", "h_lower_nm", "h_upper_nm", "seen_g", "seen_h"):
        assert np.shape(again.joint[name]) == (rows, columns)
    x, v = np.meshgrid(again.joint["angle_rad"], again.joint["velocity_rad_s"], indexing="ij")
    assert np.allclose(again.joint["g"], surfaces(again).g(x, v), atol=1e-5)
    assert np.all(np.asarray(again.joint["h_lower_nm"]) <= np.asarray(again.joint["h_upper_nm"]))
    assert len(model().to_json(None)) < 1_000_000


def test_a_record_where_the_joint_was_not_is_told():
    made = as_record(recorded_tests()[0])
    assert made.angle_rad is not None and made.velocity_rad_s is not None
    assert range_warnings(model(), made) == []
    far = replace(made, angle_rad=made.angle_rad + 2.0 + 9.0 * made.time_s)
    told = " ".join(range_warnings(model(), far))
    assert "angle" in told and "velocity" in told
    isometric = identify.fit(made)
    assert "angle" in " ".join(range_warnings(isometric, far))


def test_widths_follow_a_torque_while_the_joint_moves():
    at_s = np.arange(400) / 40.0
    arm = arm_patient(ARM)
    low, high = arm.range_rad
    angle = 0.5 * (low + high) + 0.3 * (high - low) * np.sin(0.8 * at_s)
    motion = motion_of(angle, 40.0)
    passive = above_rest(model(), np.zeros(400), 40.0, angle)
    bell = np.sin(np.pi * np.clip(at_s - 0.5, 0.0, 9.0) / 9.0) ** 2
    wanted = passive + 0.4 * surfaces(model()).g(motion.angle_rad, motion.velocity_rad_s) * 8.0 * bell
    found = invert(model(), Reference.of(wanted, angle_rad=angle))
    assert found.fit_percent > 97.0
    as_if_still = above_rest(model(), found.pulse_width_us, 40.0, np.full(400, angle[0]))
    moving = above_rest(model(), found.pulse_width_us, 40.0, angle)
    assert np.sqrt(np.mean((as_if_still - wanted) ** 2)) > 5 * np.sqrt(np.mean((moving - wanted) ** 2))


def test_what_only_the_joint_gives_is_no_reason_to_stimulate():
    """The muscle pulls one way: where the passive torque alone is above what is wanted, no pulse is sent."""
    angle = np.linspace(*arm_patient(ARM).range_rad, 200)
    passive = above_rest(model(), np.zeros(200), 40.0, angle)
    found = invert(model(), Reference.of(passive - 0.5, angle_rad=angle))
    assert np.max(found.pulse_width_us) == 0.0
    assert {one.reason for one in found.unreachable} == {"below-zero"}


def test_a_reference_without_its_angle_is_refused():
    with pytest.raises(BadModel, match="angle"):
        invert(model(), Reference.of(np.ones(80)))
    with pytest.raises(BadRequest, match="3 angles for 80"):
        Reference.of(np.ones(80), angle_rad=[1.0, 1.0, 1.0])
    with pytest.raises(BadRequest, match="degrees"):
        Reference.of(np.ones(80), angle_rad=np.full(80, 90.0))


def test_several_forms_of_an_effect_and_the_likelier_is_taken():
    forms = {entry["id"]: entry["form"] for entry in model().effects}
    assert forms["passive_torque"] == "relaxing"  # this arm's tissue gives way
    with pytest.raises(BadRequest, match="no form 'nothing'"):
        identify.fit(as_record(recorded_tests()[1 + 1]), effects=["passive_torque:surface|nothing"])


@pytest.mark.parametrize("slope", [0.0, 0.7])
def test_a_lag_follows_a_straight_line_exactly(slope: float):
    time_s = np.sort(np.r_[0.0, np.random.default_rng(0).uniform(0.0, 3.0, 20)])
    value = 1.0 + slope * time_s
    found = relaxed(value, time_s, np.zeros(21, bool), np.array([0.8]))[0]
    assert found == pytest.approx(value - 0.8 * slope * (1 - np.exp(-time_s / 0.8)))
    anew = relaxed(value, time_s, np.arange(21) == 9, np.array([0.8]))[0]
    assert anew[9] == value[9]


# ---- a curve that is chosen again with all rows: only where it was chosen with few, and the evidence rises ---------

BENT = 56
"""A curve that bends in several places, of which the isometric test alone tells little: one of the development arms."""


@cache
def bent_arm() -> ArmPatient:
    return arm_patient(BENT)


@cache
def whole() -> Record:
    made = [record(bent_arm(), "isometric", BENT), record(bent_arm(), "passive", BENT, duration_s=36.0)]
    return joined([*made, record(bent_arm(), "moving", BENT, duration_s=30.0)])


@cache
def first() -> Fitted:
    return fitted_with(whole(), MOVING_JOINT)


@cache
def renewed() -> Fitted:
    return renewed_curve(first())


def error_of(fitted: Fitted) -> float:
    """Of the curve, as a share of its largest torque, root mean square."""
    setup, place = fitted.problem.setup, fitted.problem.coefficients
    width_us = np.linspace(0.0, setup.basis.largest_us, 201)
    found_nm = setup.sign * (setup.basis.design(width_us) @ fitted.physical[place])
    f_nm = bent_arm().recruitment_nm(width_us) * float(bent_arm().g(setup.reference_rad, 0.0))
    return float(np.sqrt(np.mean((found_nm - f_nm) ** 2)) / np.ptp(f_nm))


def test_the_other_rows_tell_of_the_curve_too():
    assert renewed().log_evidence > first().log_evidence + 10
    assert error_of(renewed()) < 0.85 * error_of(first())


def test_a_model_is_not_lost_where_no_better_curve_is_found(monkeypatch: pytest.MonkeyPatch):
    base = first()
    monkeypatch.setattr("stimrig.identify.estimation.plain.solve", Mock(side_effect=np.linalg.LinAlgError))
    assert renewed_curve(base) is base


def test_a_test_at_one_angle_keeps_its_curve():
    base = fitted_with(as_record(record(bent_arm(), "isometric", 1)), ("passive_torque:linear",))
    assert renewed_curve(base) is base


def test_a_curve_that_is_no_smoothed_spline_stays_of_its_kind():
    grid, raw = prepare(whole())
    sigmoid = start(grid, fitted_rows(grid, None), {"recruitment": "sigmoid"})[0]
    base = add_effects(sigmoid, ["passive_torque:linear"], raw)
    assert renewed_curve(base) is base


@pytest.mark.campaign
def test_what_a_search_finds_is_shown_with_a_renewed_curve():
    with few_effects.only("passive_torque"):
        grid, raw = prepare(whole())
        search = search_effects(grid, raw, fitted_rows(grid, None))
        plain, found = search.steps
    assert plain.fitted is search.base and found.added == "passive_torque"
    assert found.fitted.log_evidence > search.last.log_evidence
    assert found.fitted.problem.setup.basis is not search.last.problem.setup.basis
