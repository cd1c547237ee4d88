"""A curve that is chosen again with all rows: only where it was chosen with few, and only where the evidence rises."""

from __future__ import annotations

from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest

from bench.muscles.arm_patient import ArmPatient, arm_patient
from bench.muscles.arm_records import record
from stimrig import identify
from stimrig.identify.diagnosis.search import search_effects, steps
from stimrig.identify.estimation.effect_fit import add_effects, fitted_with
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.plain import renewed_curve
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.fitting import MOVING_JOINT
from stimrig.identify.methods.maximum_likelihood import start
from stimrig.identify.records.record import Record
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.identify.test_moving_joint import joined

pytestmark = pytest.mark.slow

ARM = 56
"""A curve that bends in several places, of which the isometric test alone tells little: one of the development arms."""


@cache
def arm() -> ArmPatient:
    return arm_patient(ARM)


@cache
def whole() -> Record:
    made = [record(arm(), "isometric", ARM), record(arm(), "passive", ARM)]
    return joined([*made, record(arm(), "moving", ARM, duration_s=30.0)])


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
    f_nm = arm().recruitment_nm(width_us) * float(arm().g(setup.reference_rad, 0.0))
    return float(np.sqrt(np.mean((found_nm - f_nm) ** 2)) / np.ptp(f_nm))


def test_the_other_rows_tell_of_the_curve_too():
    assert renewed().log_evidence > first().log_evidence + 10
    assert error_of(renewed()) < 0.85 * error_of(first())


def test_a_model_is_not_lost_where_no_better_curve_is_found(monkeypatch: pytest.MonkeyPatch):
    base = first()
    monkeypatch.setattr("stimrig.identify.estimation.plain.solve", Mock(side_effect=np.linalg.LinAlgError))
    assert renewed_curve(base) is base


@pytest.mark.parametrize("effects", [(), ("passive_torque:linear",)])
def test_a_test_at_one_angle_keeps_its_curve(effects: tuple[str, ...]):
    base = fitted_with(as_record(record(arm(), "isometric", 1)), effects)
    assert renewed_curve(base) is base


def test_a_model_that_does_not_know_of_the_joint_keeps_its_curve():
    base = fitted_with(whole(), ())
    assert renewed_curve(base) is base


@pytest.mark.parametrize("options", [{"recruitment": "power-series"}, {"recruitment": "sigmoid"}])
def test_a_curve_that_is_no_smoothed_spline_stays_of_its_kind(options: dict[str, str]):
    grid, raw = prepare(whole())
    base = add_effects(start(grid, fitted_rows(grid, None), options)[0], ["passive_torque:linear"], raw)
    assert renewed_curve(base) is base


def test_the_number_of_knots_that_somebody_asks_for_is_kept():
    asked = identify.fit(whole(), effects=["passive_torque:linear"], knots=25)
    assert asked.recruitment.to_dict()["basis"]["knots_us"] == pytest.approx(
        identify.fit(whole(), knots=25).recruitment.to_dict()["basis"]["knots_us"]
    )


def test_what_a_search_finds_is_shown_with_a_renewed_curve():
    with few_effects.only("passive_torque"):
        grid, raw = prepare(whole())
        search = search_effects(grid, raw, fitted_rows(grid, None), most=1)
        plain, found = steps(search)
    assert plain.fitted is search.base and found.added == "passive_torque"
    assert found.fitted.log_evidence > search.last.log_evidence
    assert found.fitted.problem.setup.basis is not search.last.problem.setup.basis
