"""Following a model from trial to trial: what is followed, what moves nothing, what changes nothing."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from stimrig.identify.errors import BadModel, BadRecord
from stimrig.identify.fitting import fit
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.tracking import Outcome, State, Step, follow, model_for_next
from stimrig.identify.tracking.follow import moved_model
from stimrig.identify.tracking.state import USUAL, learn_rates, values_of
from tests.harness.changing import Changing, reach_widths
from tests.harness.muscle import Patient
from tests.harness.patients import make_record

pytestmark = pytest.mark.slow

PATIENT = Patient.with_rise(45.0, 120.0, gain=8.0, time_constant_s=0.25, damping=0.9)
WIDTHS = reach_widths(PATIENT)


@pytest.fixture(scope="module")
def model() -> Model:
    """What a pre-session test of the patient gives."""
    record, _ = make_record(PATIENT, np.random.default_rng(1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit(record)


def followed(model: Model, records: Sequence[Record]) -> list[Step]:
    steps, state = [], None
    for record in records:
        steps.append(follow(model, state, record))
        state = State.from_dict(json.loads(json.dumps(steps[-1].coming.to_dict())))  # as the service keeps it
    return steps


def session(muscle: Changing, trials: int, seed: int = 5, **how: Any) -> list[Record]:
    rng = np.random.default_rng(seed)
    return [muscle.play(WIDTHS, trial, rng, **how) for trial in range(trials)]


def moves(steps: Sequence[Step]) -> np.ndarray:
    """How far each trial moved each level, in units of the band that it was expected in; shape (trials, 3)."""
    return np.array(
        [
            np.abs(step.after.mean[:3] - step.before.mean[:3]) / (1.96 * np.sqrt(np.diag(step.before.covariance)[:3]))
            for step in steps
        ]
    )


@pytest.fixture(scope="module")
def unchanged(model: Model) -> State:
    """After five trials of the patient as tested: what the approved model has wrong is in these levels."""
    return followed(model, session(Changing(PATIENT), 5))[-1].after


CHANGES = {
    "fatigue": (Changing(PATIENT, gain=lambda n: 0.6 ** (n / 10)), 0, np.log(0.6) / 10),
    "potentiation": (Changing(PATIENT, gain=lambda n: 1.02**n), 0, np.log(1.02)),
    "threshold": (Changing(PATIENT, shift_us=lambda n: -0.8 * n), 1, -0.8),
    "slower": (Changing(PATIENT, time_scale=lambda n: 1.03**n), 2, np.log(1.03)),
}
NEAR = np.array([0.05, 0.6, 0.02])


@pytest.mark.parametrize("name", CHANGES)
def test_what_changes_steadily_is_followed_and_foreseen(model: Model, unchanged: State, name: str) -> None:
    muscle, quantity, per_trial = CHANGES[name]
    last = followed(model, session(muscle, 8))[-1]
    for state, trials in ((last.after, 7.5), (last.coming, 8.5)):
        away = state.mean[quantity] - unchanged.mean[quantity] - trials * per_trial
        assert abs(away) < NEAR[quantity], (name, trials, away)
        assert state.mean[3 + quantity] == pytest.approx(per_trial, rel=0.15)
    # What counts for a controller: the torque of a trial that was not seen yet.
    unseen = muscle.play(WIDTHS, 8, np.random.default_rng(0), noise_nm=0.0)
    share = [np.std(m.predict(unseen) - unseen.torque_nm) / np.std(unseen.torque_nm) for m in
             (model, model_for_next(model, last))]  # fmt: skip
    assert share[1] < 0.03 and share[1] < 0.3 * share[0], share


def test_where_nothing_changes_no_trial_moves_the_model_by_more_than_its_band(model: Model) -> None:
    steps = followed(model, session(Changing(PATIENT), 20, seed=8))
    assert np.all(moves(steps) < 1.0)
    assert {step.outcome for step in steps} <= {Outcome.FOLLOWED, Outcome.LITTLE}


@pytest.mark.parametrize(("size_nm", "at_s", "width_s"), [(-2.5, 8.0, 0.3), (1.5, 6.0, 1.2)])
def test_a_spasm_or_an_effort_moves_nothing_by_more_than_its_band(
    model: Model, size_nm: float, at_s: float, width_s: float
) -> None:
    bump = lambda trial, time_s: (trial == 3) * size_nm * np.exp(-0.5 * ((time_s - at_s) / width_s) ** 2)  # noqa: E731
    steps = followed(model, session(Changing(PATIENT, added=bump), 6))
    assert np.all(moves(steps) < 1.0)
    stretches = steps[3].fit.disturbed
    assert steps[3].outcome is Outcome.ODD or any(begin <= at_s <= end for begin, end in stretches)
    assert steps[4].outcome is not Outcome.CONTRADICTS
    assert not any(step.fit.disturbed for step in (*steps[:3], *steps[4:]))


def test_a_sudden_change_is_followed_when_the_next_trial_says_the_same(model: Model) -> None:
    muscle = Changing(PATIENT, gain=lambda n: 1.0 if n < 3 else 0.7)
    steps = followed(model, session(muscle, 6))
    assert steps[3].outcome is Outcome.ODD
    assert steps[3].disturbed_s == [[0.0, steps[3].fit.duration_s]], "from an odd trial nothing is learnt"
    assert np.all(moves(steps[:4]) < 1.0)
    assert steps[4].outcome is Outcome.FOLLOWED
    gains = [step.after.values["gain"] for step in steps]
    assert gains[4] / gains[2] == pytest.approx(0.7, abs=0.03)
    assert gains[5] / gains[2] == pytest.approx(0.7, abs=0.03)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_a_loose_electrode_is_told_at_once_and_moves_nothing(model: Model, share: float) -> None:
    steps = followed(model, session(Changing(PATIENT, gain=lambda n: share if 3 <= n < 6 else 1.0), 8))
    assert {step.outcome for step in steps[3:6]} == {Outcome.NO_TORQUE}
    assert {step.outcome for step in (*steps[:3], *steps[6:])} == {Outcome.FOLLOWED}
    for step in steps[3:6]:
        assert step.disturbed_s == [[0.0, step.fit.duration_s]]
        assert np.array_equal(step.after.mean, step.before.mean)
    assert np.all(moves(steps) < 1.0)


@pytest.mark.parametrize("seed", [7, 11])
@pytest.mark.parametrize("gain", [0.6, 0.3])
def test_a_sudden_loss_is_found_and_not_taken_for_a_threshold(model: Model, gain: float, seed: int) -> None:
    """The fit of a trial has a second place to end, where the threshold rose."""
    steps = followed(model, session(Changing(PATIENT, gain=lambda n: 1.0 if n < 3 else gain), 6, seed))
    assert steps[3].outcome is Outcome.ODD
    assert steps[-1].after.values["gain"] == pytest.approx(gain, rel=0.06)
    assert abs(steps[-1].after.values["threshold_shift_us"]) < 2.0


@pytest.mark.parametrize("drift_nm", [0.3, -0.6])
def test_a_zero_that_drifts_within_trials_is_no_change_of_the_muscle(model: Model, drift_nm: float) -> None:
    drifting = Changing(PATIENT, added=lambda _, time_s: drift_nm * time_s / time_s[-1])
    plain, found = (followed(model, session(muscle, 5))[-1] for muscle in (Changing(PATIENT), drifting))
    sd = np.sqrt(np.diag(plain.after.covariance)[:3])
    assert np.all(np.abs(found.after.mean - plain.after.mean)[:3] < 0.3 * sd)
    assert found.outcome is Outcome.FOLLOWED


def test_another_structure_is_told_when_two_trials_show_it(model: Model) -> None:
    other = Changing(PATIENT, added=lambda _, time_s: 0.8 * np.sin(2 * np.pi * 1.3 * time_s))
    steps = followed(model, session(Changing(PATIENT), 2) + session(other, 3))
    assert [step.outcome for step in steps[2:]] == [Outcome.ODD, Outcome.CONTRADICTS, Outcome.CONTRADICTS]
    assert steps[-1].after.values == values_of(steps[-1].before.mean)
    back = follow(model, steps[-1].coming, session(Changing(PATIENT), 1)[0])
    assert back.outcome is not Outcome.CONTRADICTS and back.after.unexplained == 0


def test_a_trial_that_tells_little_moves_little_and_says_so(model: Model) -> None:
    rest = np.zeros(200)
    barely = np.r_[np.zeros(40), np.full(60, 5.0), np.zeros(40)]
    for widths in (rest, barely):
        record = Changing(PATIENT).play(widths, 0, np.random.default_rng(3))
        step = follow(model, None, record)
        assert step.outcome is Outcome.LITTLE
        assert np.all(moves([step]) < 0.5)
        assert np.all(np.diag(step.after.covariance)[:3] > 0.3 * np.diag(step.before.covariance)[:3])


ALIKE: dict[str, dict[str, float]] = {
    "upside down, another zero and start": {"sign": -1.0, "baseline_nm": 7.3, "start_s": 1000.0},
    "a slow recorder": {"rate_hz": 80.0},
    "a fast recorder": {"rate_hz": 2000.0, "noise_nm": 0.11},
}


@pytest.mark.parametrize("name", ALIKE)
def test_what_changes_nothing_about_the_muscle_changes_no_answer(model: Model, name: str) -> None:
    how = ALIKE[name]
    muscle = Changing(PATIENT, gain=lambda n: 0.95**n, shift_us=lambda n: 0.5 * n)
    usual = followed(model, session(muscle, 5))[-1]
    turned = model
    if how.get("sign") == -1.0:
        record, _ = make_record(PATIENT, np.random.default_rng(1))
        turned = fit(record.with_torque(-record.torque_nm))
    other = followed(turned, session(muscle, 5, **how))[-1]
    sd = np.sqrt(np.diag(usual.after.covariance)[:3] + np.diag(other.after.covariance)[:3])
    assert np.all(np.abs(usual.after.mean[:3] - other.after.mean[:3]) < 3.0 * sd + [0.004, 0.1, 0.01])
    assert usual.outcome == other.outcome


def test_the_moved_model_is_the_muscle_as_it_is_now(model: Model) -> None:
    moved = Model.from_json(moved_model(model, np.array([np.log(0.8), 9.0, np.log(1.2)])).to_json())
    width = np.linspace(0.0, 300.0, 601)
    wanted = 0.8 * model.recruitment(np.maximum(width - 9.0, 0.0))
    assert np.max(np.abs(moved.recruitment(width) - wanted)) < 2e-3 * np.ptp(wanted)
    muscle = Changing(PATIENT, gain=lambda _: 0.8, shift_us=lambda _: 9.0, time_scale=lambda _: 1.2)
    record = muscle.play(WIDTHS, 0, np.random.default_rng(4), noise_nm=0.0)
    error = moved.predict(record) - record.torque_nm
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.ptp(record.torque_nm)
    assert moved_model(model, np.zeros(3)).to_dict()["recruitment"] == model.to_dict()["recruitment"]


def test_dynamics_of_another_kind_are_refused_with_the_mend() -> None:
    record, _ = make_record(PATIENT, np.random.default_rng(1))
    other = fit(record, method="narx")
    trial = Changing(PATIENT).play(WIDTHS, 0, np.random.default_rng(2))
    with pytest.raises(BadModel, match="second-order"):
        follow(other, None, trial)
    with pytest.raises(BadModel, match="second-order"):
        moved_model(other, np.array([-0.1, 0.0, 0.0]))


@pytest.mark.parametrize("held_out", [False, True])
def test_a_trial_without_a_second_to_use_is_refused(model: Model, held_out: bool) -> None:
    whole = Changing(PATIENT).play(WIDTHS, 0, np.random.default_rng(2))
    kept = slice(None) if held_out else slice(0, 350)
    names = np.full(whole.time_s.size, "validate" if held_out else "trial")[kept]
    cut = Record.from_arrays(whole.time_s[kept], whole.pulse_width_us[kept], whole.torque_nm[kept], names)
    with pytest.raises(BadRecord, match="less than 1 s"):
        follow(model, None, cut)


def test_another_pulse_rate_is_refused(model: Model) -> None:
    time_s = np.arange(2000) / 400.0
    record = Record.from_arrays(time_s, np.full(2000, 100.0), np.zeros(2000), pulse_rate_hz=20.0)
    with pytest.raises(BadModel, match="pulses a second"):
        follow(model, None, record)


def test_a_trial_that_begins_within_a_contraction(model: Model) -> None:
    whole = Changing(PATIENT, gain=lambda _: 0.9).play(WIDTHS, 0, np.random.default_rng(2))
    cut = whole.take(whole.time_s > 4.0)
    part, all_of_it = follow(model, None, cut).after, follow(model, None, whole).after
    assert np.all(np.abs(part.mean - all_of_it.mean)[:3] < 1.96 * np.sqrt(np.diag(part.covariance)[:3]))


def test_forty_trials_stay_well_behaved(model: Model) -> None:
    rng, state = np.random.default_rng(9), None
    muscle = Changing(PATIENT, gain=lambda n: 1.0 + 0.1 * np.sin(n / 9))
    for trial in range(40):
        step = follow(model, state, muscle.play(WIDTHS, trial, rng))
        state = step.coming
    assert np.linalg.eigvalsh(step.after.covariance).min() > -1e-12
    assert step.after.values["gain"] == pytest.approx(1.0 + 0.1 * np.sin(39.5 / 9), abs=0.04)
    assert moves([step]).max() < 1.0


def test_a_person_who_always_tires_is_expected_to(model: Model) -> None:
    muscle = Changing(PATIENT, gain=lambda n: 0.95**n)
    told = [[step.after.bands() for step in followed(model, session(muscle, 6, seed))] for seed in (11, 12, 13)]
    rates = learn_rates(told)
    assert np.log(0.95) < rates.trend[0] < 0.4 * np.log(0.95)
    assert rates.trend[1] == pytest.approx(0.0, abs=0.1) and rates.trend[2] == pytest.approx(0.0, abs=0.005)
    first = session(muscle, 1, seed=14)[0]
    usual, learnt = follow(model, None, first), follow(model, None, first, rates)
    wanted = usual.after.values["gain"] * 0.95
    assert abs(learnt.coming.values["gain"] - wanted) < 0.75 * abs(usual.coming.values["gain"] - wanted)


def test_a_person_who_jumps_about_gets_wider_bands(model: Model) -> None:
    rng = np.random.default_rng(6)
    levels = rng.normal(0.0, 0.06, 30)
    jumping = Changing(PATIENT, gain=lambda n: float(np.exp(levels[int(n)])))
    bands = [[step.after.bands() for step in followed(model, session(jumping, 10, seed))] for seed in (21, 22)]
    rates = learn_rates(bands)
    assert rates.step[0] > 3.0 * USUAL.step[0] and rates.step[2] < 1.5 * USUAL.step[2]
