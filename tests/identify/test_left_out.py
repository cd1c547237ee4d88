"""Left-out blocks: what they are, that they are not seen, and what follows from them."""

from __future__ import annotations

import gc
import re
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bench.muscles.bout_records import record_of_bouts
from bench.muscles.hidden_records import generate
from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import improvement, search, thresholds
from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import required_errors
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation import left_out
from stimrig.identify.estimation.candidates import similar_bout_rows
from stimrig.identify.estimation.effect_fit import Candidate, fitted_with
from stimrig.identify.estimation.fit_statistics import held_out_change
from stimrig.identify.estimation.left_out import LeftOut, blocks, bouts, difference, from_to, hold_out, leave_out
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.join import join
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record


@pytest.fixture(scope="module")
def plain_record() -> identify.Record:
    return as_record(generate(None, "middle", 3, rate_hz=200))


def arm(seed: int) -> identify.Record:
    return as_record(record_of_bouts(seed))


def pair(old: list[float], new: list[float], floor_nm: float = 0.0, wander_nm: float = 0.0, offset: float = 0.0):
    """Two models with these errors (standard deviations) in blocks of 50 rows."""
    rng, block = np.random.default_rng(1), np.repeat(np.arange(len(old)), 50)
    shape = rng.standard_normal((len(old), 50))
    shape -= shape.mean(axis=1, keepdims=True)
    return [LeftOut((np.array(sd)[:, None] * shape + offset).ravel(), block, floor_nm, wander_nm) for sd in (old, new)]


def test_many_short_bouts_are_joined():
    """Each would be a fit of all others: time grew with the square of their number."""
    widths = np.tile(np.r_[np.full(12, 250.0), np.zeros(48)], 120)
    grid = make_grid(identify.Record.from_arrays(np.arange(widths.size) / 40.0, widths, widths))
    numbers, rows = np.unique(blocks(grid, grid.fitted), return_counts=True)
    assert 5 <= numbers.size <= 2 * left_out.PIECES and rows.min() >= 0.5 * widths.size / left_out.PIECES


def test_blocks_are_whole_bouts_or_pieces_of_them_and_follow_from_the_pulses_alone(plain_record):
    for record in (plain_record, arm(0)):
        grid, _ = prepare(record)
        rows = fitted_rows(grid, None)
        block = blocks(grid, rows)
        assert np.array_equal(block >= 0, rows) and np.unique(block[rows]).size >= 8
        assert np.all(block[grid.held_out] == -1)
        for number in np.unique(block[rows]):
            assert np.unique(bouts(grid)[block == number]).size == 1
        assert np.bincount(block[rows]).max() <= 1.6 * max(rows.sum() / 10, 80)
        other, _ = prepare(record.with_torque(record.torque_nm[::-1].copy()))
        assert np.array_equal(blocks(other, rows), block)


def test_a_left_out_block_is_not_seen(plain_record):
    """Another torque in a block moves what is predicted there by next to nothing, and what is fitted there by a lot."""
    grid, _ = prepare(plain_record)
    rows = fitted_rows(grid, None)
    number = int(np.unique(blocks(grid, rows)[rows])[4])
    own = blocks(grid, rows) == number
    before = fit_plain(grid, rows)
    spoiled = np.where(own, grid.torque_nm + 2.0 * np.sin(0.7 * np.arange(grid.size)), grid.torque_nm)
    setup = before.problem.setup.with_(target_nm=before.problem.setup.to_muscle(spoiled))
    first, seen = leave_out(before), np.isfinite(leave_out(before).error_nm) & own
    mean = before.problem.run(before.theta)[0]
    after = leave_out(replace(before, problem=Problem(setup, before.effects), residual_nm=setup.target_nm - mean))
    moved = (setup.target_nm - after.error_nm) - (before.problem.setup.target_nm - first.error_nm)
    assert seen.sum() > 20
    assert np.max(np.abs(moved[seen])) < 1e-6
    assert np.max(np.abs(first.error_nm[seen] - after.error_nm[seen])) > 1.0


def test_what_is_computed_once_lives_no_longer_than_its_fit(plain_record):
    grid, _ = prepare(plain_record)
    fitted = fit_plain(grid, fitted_rows(grid, None))
    assert leave_out(fitted) is leave_out(fitted) and held_out_change(fitted) is held_out_change(fitted)
    alive = weakref.ref(fitted)
    del fitted
    gc.collect()
    assert alive() is None


def test_one_block_alone_tells_nothing_and_what_all_say_counts():
    alone = difference(*pair([1.0] * 10, [0.1] + [1.0] * 9, floor_nm=1.0))
    assert alone.errors < 2.0
    assert difference(*pair([1.0] * 10, [0.8, 0.82] * 5)).errors > 10.0
    there, back = difference(*pair([1.0, 2.0] * 5, [0.7, 1.9] * 5)), difference(*pair([0.7, 1.9] * 5, [1.0, 2.0] * 5))
    assert there.errors == pytest.approx(-back.errors) and there.gain == pytest.approx(-back.gain)


def test_what_is_below_the_noise_does_not_count_and_blocks_at_noise_tell_little():
    assert abs(difference(*pair([0.1] * 10, [0.001] * 10, floor_nm=1.0)).gain) < 0.01
    few = difference(*pair([0.1] * 8 + [5.0, 6.0], [0.1] * 8 + [1.0, 1.1], floor_nm=0.1))
    assert few.errors > 2.0 and few.blocks < 3.0


def test_a_held_out_error_that_rises_is_said_to_rise(monkeypatch: pytest.MonkeyPatch):
    """Of a zero that drifts, so that the pieces' own zeros tell another story than the error itself."""
    left_out = pair([2.0, 1.0] * 5, [1.1, 0.45] * 5)
    monkeypatch.setattr(improvement, "hold_out", lambda fitted: left_out[fitted])
    steps = [
        SimpleNamespace(
            added="baseline_drift", origin="library", left_out=left_out[number], fitted=number,
            tried=[SimpleNamespace(effect=find_effect("baseline_drift"), gain=50.0)],
            statistics={"held_out_by": "validate", "held_out_rms_nm": rms_nm},
        )
        for number, rms_nm in enumerate((0.341, 0.488))
    ]  # fmt: skip
    search = SimpleNamespace(margin=lambda _number: 4.5, names=lambda _origin: ["baseline_drift"])
    reason = improvement._reason(search, *steps, None)  # type: ignore
    assert "On held-out pulses the error rises from 0.341 to 0.488 N·m; about the zero" in reason
    assert re.search(r"of them it falls by \d+ % \(\d+\.\d standard errors\)\.$", reason)
    assert from_to(0.488, 0.341) == "falls from 0.488 to 0.341 N·m"


def test_a_zero_that_wanders_is_no_fault_of_a_model():
    shifted, still = pair([1.0] * 10, [1.0] * 10, wander_nm=2.0, offset=3.0)
    own = still.block == 0
    assert shifted.square(own) == pytest.approx(LeftOut(still.error_nm - 3.0, still.block, 0.0).square(own))
    held = replace(still, wander_nm=0.0)
    assert held.square(own) == pytest.approx(still.square(own) + 9.0)


def test_each_part_of_a_record_has_its_own_zero(plain_record):
    def scatter_nm(*zeros_nm: float) -> float:
        records = (plain_record, as_record(generate(None, "middle", 4, rate_hz=200)))
        parts = [one.with_torque(one.torque_nm + zero_nm) for one, zero_nm in zip(records, zeros_nm, strict=True)]
        return leave_out(fitted_with(join(parts, [0.0, 500.0]), [])).wander_nm

    assert scatter_nm(0.0, 3.0) == pytest.approx(scatter_nm(0.0, 0.0), rel=1e-6)


def test_efforts_that_only_a_doubtful_likelihood_asks_for_must_not_predict_worse(plain_record):
    """Fatigue beside noise as slow as it may be: an effort was added, by which the left-out error rose."""
    fitted = fitted_with(plain_record, [])
    effort = Candidate(find_effect("voluntary_effort"), find_effect("voluntary_effort").forms[0], fitted, 30.0, {})
    slow = replace(fitted, noise=replace(fitted.noise, ar1=0.994, share=1.0))
    asked = [required_errors(SimpleNamespace(last=one, names=lambda _origin: []), effort) for one in (fitted, slow)]
    assert asked == [-thresholds.BETTER, 0.0]


def test_effects_found_after_one_that_held_out_rows_speak_against_are_told(monkeypatch):
    row = [search.Step(name, None, "library" if name else "base") for name in (None, "fatigue", "tremor")]
    monkeypatch.setattr(search, "vetoed", lambda _before, _after: "the error would rise")
    left, against = search.helpful(SimpleNamespace(steps=row))
    assert left == row[:1] and [entry["effect"] for entry in against] == ["fatigue", "tremor"]
    assert against[0]["reason"] == "the error would rise" and "Fatigue" in against[1]["reason"]


def test_rows_of_validate_do_not_choose_rows_or_noise():
    record = arm(1)
    grid, _ = prepare(record)
    rows = fitted_rows(grid, None)
    own = similar_bout_rows(grid, rows)
    assert own is not None and 0.2 < own.sum() / rows.sum() < 0.8 and not np.any(own & grid.held_out)
    other = record.with_torque(np.where(record.held_out, -3.0 * record.torque_nm, record.torque_nm))
    models = [identify.fit(one) for one in (record, other)]
    assert models[0].linear == models[1].linear
    assert any("taken as white" in reason for reason in models[0].reasons)


def test_held_out_rows_may_object_and_never_ask(plain_record):
    plain = fitted_with(plain_record, [])
    worse = replace(plain, theta=plain.theta + 0.2 * (np.arange(plain.theta.size) == 0))
    assert vetoed(worse, plain) is None
    assert f"would rise from {hold_out(plain).rms_nm:.3g} to " in (vetoed(plain, worse) or "")


@pytest.mark.slow
def test_what_is_likely_and_does_not_predict_is_refused():
    """Breath on a plain muscle: slow noise explains it best, but effects repair it and gain log evidence."""
    record = as_record(record_of_physics("plain", 2))
    with few_effects.only("asymmetric_relaxation", "activation_dependent_speed"):
        result = identify.improve(record)
    assert [step["added"] for step in result.steps] == [None]
    assert any("parts left out of the fit" in row["reason"] for row in result.refused)
