"""The slow states of effects (fatigue, potentiation) are carried through the pulses and rests of a session."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.muscles.offline import simulate
from stimrig.hardware_sim import patients
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.effects import registry as effects
from stimrig.identify.errors import BadModel
from stimrig.identify.fitting import fit
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import predict, problem_of
from stimrig.identify.records.record import Part, Record
from stimrig.identify.tracking import State, follow, model_for_next
from stimrig.identify.tracking.follow import begin, moved_model, passed, rested, set_states
from tests.harness.muscle import Patient
from tests.harness.patients import make_record

pytestmark = pytest.mark.slow

SEED = 54200
PER, RATE_HZ, CURRENT_MA = 10, 400.0, 20.0
SLOW = [(effect.id, form.name) for effect in effects().values() for form in effect.forms if form.state is not None]
PATIENT = Patient.with_rise(45.0, 120.0, gain=8.0, time_constant_s=0.2, damping=0.9)
WIDTHS = np.r_[np.zeros(40), np.linspace(60.0, 200.0, 160), np.full(120, 160.0), np.zeros(120), np.full(120, 140.0)]


@pytest.fixture(scope="module")
def tested() -> Record:
    return make_record(PATIENT, np.random.default_rng(SEED))[0]


@pytest.fixture(scope="module")
def plain(tested: Record) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit(tested)


def having(model: Model, effect_id: str, name: str, **more: Any) -> Model:
    """The model with an effect at its starting values."""
    form = effects()[effect_id].form(name)
    entry = {"id": effect_id, "form": name, "parameters": {p.name: p.start[0] for p in form.parameters}}
    settings = {"scale_nm": 8.0, "zero_nm": 0.0, "sign": 1.0, "reference_s": 0.0}
    return model.with_(effects=({**entry, "settings": settings, **more},))


def record_of(widths_us: np.ndarray, begun_s: float | None = None, torque_nm: np.ndarray | None = None) -> Record:
    time_s = np.arange(widths_us.size * PER) / RATE_HZ
    torque_nm = np.zeros(time_s.size) if torque_nm is None else torque_nm
    names = ["trial"] * time_s.size
    return Record.from_arrays(time_s, np.repeat(widths_us, PER), torque_nm, names, parts=(Part(begun_s=begun_s),))


@pytest.mark.parametrize(("effect", "form"), SLOW)
def test_a_record_cut_in_two_with_its_state_is_the_uncut_one(plain: Model, effect: str, form: str) -> None:
    model, cut = having(plain, effect, form), 240
    whole = problem_of(model, make_grid(record_of(WIDTHS)))
    first = passed(model, begin(model), record_of(WIDTHS[:cut]))
    second = passed(model, first, record_of(WIDTHS[cut:]), 0.0)
    assert second.effects == pytest.approx(whole[0].states(whole[1]), abs=1e-9)
    assert 0.01 < first.effects[effect] < 1.0
    # So is its torque, if it is cut where the muscle has come to rest; without the state it is another one.
    quiet = 435
    before, after = record_of(WIDTHS[:quiet]), record_of(WIDTHS[quiet:])
    wanted = predict(model, record_of(WIDTHS))[quiet * PER :]
    carried = set_states(model, passed(model, begin(model), before).effects)
    assert predict(carried, after) == pytest.approx(wanted, abs=2e-3)
    if effect != "catch_like":  # that has worn off by then
        assert np.max(np.abs(predict(model, after) - wanted)) > 0.2


@pytest.mark.parametrize(("effect", "form"), SLOW)
def test_a_rest_is_as_long_as_the_same_silence(plain: Model, effect: str, form: str) -> None:
    model = having(plain, effect, form)
    tired = passed(model, begin(model), record_of(WIDTHS))
    silence = passed(model, tired, record_of(np.zeros(400)), 0.0).effects
    assert rested(model, tired.effects, 10.0) == pytest.approx(silence, abs=1e-9)
    assert rested(model, tired.effects, 0.0) == tired.effects
    assert rested(model, tired.effects, math.inf) == rested(model, tired.effects, None) == {effect: 0.0}


@pytest.mark.parametrize("state", [math.nan, -0.01, 1.01, math.inf, "0.5", True, None])
def test_a_state_that_is_none_is_refused_with_place_and_mend(plain: Model, state: Any) -> None:
    model = having(plain, "fatigue", "fitness", state=state)
    with pytest.raises(BadModel, match=r"effects\.fatigue\.state.*rested"):
        predict(model, record_of(WIDTHS))
    document = {**plain.to_dict(), "effects": list(model.effects)}
    with pytest.raises(BadModel, match=r"effects\.0\.state.*rested"):
        Model.from_dict(document)


def test_on_its_own_record_a_model_begins_rested(plain: Model, tested: Record) -> None:
    model = having(plain, "fatigue", "fitness")
    tired = set_states(model, {"fatigue": 0.8})
    assert np.array_equal(model.predict(tested), tired.predict(tested))
    trial = record_of(WIDTHS)
    assert not np.array_equal(model.predict(trial), tired.predict(trial))


def test_state_and_model_come_back_from_their_files(plain: Model) -> None:
    model = having(plain, "fatigue", "fitness")
    step = follow(model, passed(model, begin(model), record_of(WIDTHS, 100.0)), trial_of(model), rest_s=20.0)
    back = State.from_dict(json.loads(json.dumps(step.coming.to_dict())))
    assert back.effects == step.coming.effects and back.ended_s == step.coming.ended_s
    moved = Model.from_json(model_for_next(model, step).to_json())
    assert moved.effects[0]["state"] == step.to_dict()["effects"]["fatigue"]["coming"] > 0.0
    assert "state" not in model.effects[0]


def trial_of(model: Model, begun_s: float | None = None) -> Record:
    torque_nm = predict(model, record_of(WIDTHS))
    return record_of(WIDTHS, begun_s, torque_nm + 0.05 * np.random.default_rng(SEED).standard_normal(torque_nm.size))


def test_rests_are_told_by_the_clocks_of_the_records(plain: Model) -> None:
    model = having(plain, "fatigue", "fitness")
    span_s = WIDTHS.size / 40.0
    tested = passed(model, begin(model), record_of(WIDTHS, 1000.0))
    assert tested.ended_s == pytest.approx(1000.0 + span_s, abs=1e-6)
    by_clock = follow(model, tested, trial_of(model, 1000.0 + span_s + 30.0))
    given = follow(model, tested, trial_of(model), rest_s=30.0)
    assert by_clock.after.effects["fatigue"] == pytest.approx(given.after.effects["fatigue"], abs=1e-6)
    rested_first = follow(model, None, trial_of(model))
    assert given.after.effects["fatigue"] > 1.05 * rested_first.after.effects["fatigue"]
    # A rest that nobody knows is taken for a long one; so is one that cannot be.
    for record, rest_s in ((trial_of(model), None), (trial_of(model), math.nan), (trial_of(model, 500.0), None)):
        assert follow(model, tested, record, rest_s=rest_s).after.effects["fatigue"] == pytest.approx(
            rested_first.after.effects["fatigue"], abs=1e-9
        )


def test_the_tracked_gain_takes_part_in_what_tires(plain: Model) -> None:
    model = having(plain, "fatigue", "fitness")
    weak = begin(model)
    weak = replace(weak, mean=np.r_[np.log(0.5), weak.mean[1:]])
    usual, less = passed(model, begin(model), record_of(WIDTHS)), passed(model, weak, record_of(WIDTHS))
    assert less.effects["fatigue"] < 0.75 * usual.effects["fatigue"]
    served = moved_model(model, weak.mean)
    assert less.effects == pytest.approx(passed(served, begin(served), record_of(WIDTHS)).effects, abs=1e-6)


# ---- against a muscle with laws of its own ----------------------------------------------------------------------


class Person:
    """`stimrig.hardware_sim.patients.changing` on one clock."""

    def __init__(self, **changes: float) -> None:
        self.muscle = patients.make("changing", {"natural_period_s": 0.2, **changes})
        self.rng, self.now_s = np.random.default_rng(SEED), 0.0

    def play(self, widths_us: np.ndarray, rest_s: float = 0.0) -> Record:
        self.now_s += rest_s
        times = self.now_s + np.arange(widths_us.size) / 40.0
        span_s = widths_us.size / 40.0
        clean = simulate(self.muscle, times, widths_us, CURRENT_MA, RATE_HZ, span_s, self.now_s)
        record = record_of(widths_us, self.now_s, clean + 0.05 * self.rng.standard_normal(clean.size))
        self.now_s += span_s
        return record


def _test_widths() -> np.ndarray:
    rng = np.random.default_rng(SEED)
    steps = np.repeat(rng.integers(60, 300, 50), 20).astype(float)
    ramp = np.r_[np.linspace(0.0, 300.0, 240), np.linspace(300.0, 0.0, 240)]
    return np.r_[np.zeros(60), ramp, np.zeros(60), steps, np.zeros(60), ramp, np.zeros(60)].round()


def test_the_next_trial_is_foretold_better_with_the_states() -> None:
    person = Person(fatigue_share=0.5, fatigue_recovery_s=90.0)
    test = person.play(_test_widths())
    model = fit(test, effects=["fatigue"])
    widths = np.r_[np.zeros(40), np.linspace(60.0, 170.0, 160), np.full(160, 170.0), np.full(80, 110.0), np.zeros(40)]
    carried, forgot = passed(model, begin(model), test), begin(model)
    errors = []
    # The test hardly shows how it recovers (190 s, sd 70): soon after it that hardly matters.
    for rest_s in (10.0, 10.0, 60.0, 120.0, 10.0, 150.0):
        trial = person.play(widths, rest_s)
        expected = [
            moved_model(model, state.mean, state.mean[6:], rested(model, state.effects, rest_s))
            for state in (carried, forgot)
        ]
        errors.append([float(np.std(one.predict(trial) - trial.torque_nm)) for one in expected])
        carried = follow(model, carried, trial).coming
        forgot = follow(model, forgot, trial, rest_s=math.inf).coming
        forgot = replace(forgot, effects={})
    found = np.array(errors)
    assert found[0, 0] < 0.85 * found[0, 1], "the first trial knows what the test did"
    with_states_nm, without_nm = np.sqrt(np.mean(found**2, axis=0))
    assert with_states_nm < 0.5 * without_nm, found
