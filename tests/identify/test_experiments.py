"""The experiment that decides: there where structure is left, within the limits, the same each time, and it teaches."""

from __future__ import annotations

import numpy as np
import pytest

from bench.muscles.physics_records import further_record, record_of_physics
from stimrig import identify
from stimrig.identify import experiments
from stimrig.identify.diagnosis.search import Step
from stimrig.identify.estimation.effect_fit import fitted_with
from stimrig.identify.experiments import expected_log_evidence, plan, plan_further
from stimrig.identify.experiments.designs import SHAPES, designs, held_levels, pieces
from stimrig.identify.records.join import join
from stimrig.rig.sequences import build
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.identify import hidden_muscles

SEED = 0


@pytest.fixture(scope="module")
def made():
    return record_of_physics("physics", SEED, ())


@pytest.fixture(scope="module")
def diagnosis(made):
    with few_effects.only("fatigue", "free_strength_by_pulses"):
        return identify.diagnose(as_record(made))


def played_us(experiment):
    return np.concatenate([build(one["sequence"], dict(one["settings"]), 40.0) for one in experiment.segments])


def test_the_rig_plays_what_was_simulated_and_every_piece_of_an_adaptive_test():
    tests = [*held_levels(300.0, 80.0, 40.0, 7), *designs(300.0)]
    parts = pieces(np.array([0.0, 60.04, 137.77, 300.0]), 40.0)
    assert all(0.9 <= len(piece.settings["pulse_width_us"]) / 40.0 <= 2.1 for piece in parts)
    for segment in [*(segment for design in tests for segment in design.segments), *parts]:
        played = build(segment.sequence, segment.settings, 40.0)
        np.testing.assert_allclose(played, SHAPES[segment.sequence](segment.settings, 40.0))
        assert played.min() >= 0.0 and played.max() <= 300.0


def test_the_muscle_decides_which_design_is_chosen():
    records = [as_record(record_of_physics("physics", seed, ())) for seed in (0, 1)]
    chosen = {plan_further(record, fitted_with(record, [])).text.partition(" (")[0] for record in records}
    assert len(chosen) == 2


@pytest.fixture(scope="module")
def rivals(made):
    return {name: fitted_with(as_record(made), [name]) for name in ("free_torque_by_torque", "free_width_by_torque")}


def test_terms_that_predict_left_out_parts_as_well_are_rivals_and_others_are_none(made, rivals):
    first, second = rivals.values()
    better = fitted_with(as_record(made), ["free_factor_by_square"])
    assert Step(None, first, "free", others=(second,)).rivals == [second]
    assert Step(None, better, "free", others=(first, second)).rivals == []


@pytest.mark.parametrize(
    ("gains", "words"), [((1.0, 3.0, 2.0), "near the threshold"), ((1.0, 2.0, 3.0), "a fast ramp")]
)
def test_the_design_that_separates_rivals_best_is_chosen(made, rivals, monkeypatch: pytest.MonkeyPatch, gains, words):
    first, second = rivals.values()
    given = iter(gains)
    monkeypatch.setattr(experiments, "expected_log_evidence", lambda *_: next(given))
    found = plan_further(as_record(made), first, [second])
    assert words in found.text and "separate" in found.text and found.expected_log_evidence == 3


def test_a_tremor_is_no_reason_to_choose_none():
    record = hidden_muscles.record("tremor", seed=3, rate_hz=100)
    fitted = fitted_with(record, ["tremor"])
    found = plan_further(record, fitted).expected_fall
    assert fitted.noise.band > 0.0 and found is not None and 0.0 < found < 1.0


def test_one_is_planned_from_joined_records_too():
    """Their parts have a zero each, and the new test has one part."""
    parts = [hidden_muscles.record(seed=seed, rate_hz=100) for seed in (3, 4)]
    both = join(parts, [0.0, 600.0])
    found = plan_further(both, fitted_with(both, [])).expected_fall
    assert found is not None and 0.0 < found < 1.0


def test_it_is_there_where_structure_is_left_and_keeps_the_limits(made, diagnosis):
    found = identify.next_experiment(diagnosis)
    assert diagnosis.verdict == "unexplained_structure" and found is not None and found.text in str(diagnosis)
    assert found.duration_s <= 40.0
    assert 0.0 < played_us(found).max() <= made["pulse_width_us"].max()
    assert found.dose["pulses"] == np.sum(played_us(found) > 0)


def test_both_records_together_foretell_a_further_one_better_than_the_first_alone(made, diagnosis):
    experiment = identify.next_experiment(diagnosis)
    assert experiment is not None
    first = as_record(made)
    further = as_record(further_record("physics", SEED, (), played_us(experiment)))
    both = join([first, further], [0.0, 1200.0])
    error_nm = []
    for record in (first, both):
        model = identify.fit(record, effects=["free_strength_by_pulses"])
        off = identify.predict(model, as_record(made["unseen"])) - made["unseen"]["torque_nm"]
        error_nm.append(np.std(off))
    assert error_nm[1] < error_nm[0]


def test_hysteresis_and_drift_are_told_apart_by_another_ramp():
    record = hidden_muscles.record("threshold_drift", seed=16, rate_hz=100)
    fits = {name: fitted_with(record, [name]) for name in ("threshold_drift", "recruitment_hysteresis")}
    found = plan(record, fits)
    assert found.decides and "ramp" in found.text
    assert found.duration_s < 40.0 and found.dose["pulses"] > 0
    assert max(s["settings"].get("max_pulse_width_us", 0.0) for s in found.segments) <= 300.0
    sham = next(design for design in designs(300.0) if design.words == "A test without stimulation").pulse_widths(40.0)
    assert expected_log_evidence(sham, record, fits) < found.expected_log_evidence
