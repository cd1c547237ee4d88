"""Free effects: exact where nothing is free, found on other physics, absent where nothing is missing."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import free, result
from stimrig.identify.diagnosis.search import resembles_earlier, search_effects, silent
from stimrig.identify.dynamics.free_lags import FreeLaw, run_free
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.linear import Discrete, SecondOrder
from stimrig.identify.dynamics.second_order import boundary_states
from stimrig.identify.effects import registry
from stimrig.identify.effects.base import Form
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.estimation.quality import _stable
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.inversion import Reference, invert
from stimrig.identify.model import Model
from stimrig.identify.problem.predict import problem_of
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis, Improvement
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.identify import hidden_muscles

STEP_S, SIZE = 0.025, 400
FREE = [effect for effect in registry().values() if effect.shape]
FORMS = [(effect, form) for effect in FREE for form in effect.forms]
TRIED = "free_gate", "asymmetric_relaxation", "baseline_drift"
"""Each costs seconds, free_ways as much as all of these; what all of them find is in bench.strange."""
named = partial(pytest.mark.parametrize, ids=lambda one: getattr(one, "id", getattr(one, "name", None)))


def drive(seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).choice([0.0, 1.0, 3.0, 5.0], SIZE // 20), 20)


def run(drives: np.ndarray, core: tuple[float, float], **laws: float) -> tuple[np.ndarray, np.ndarray]:
    table = np.zeros((len(drives), len(FreeLaw)))
    for name, value in laws.items():
        table[:, FreeLaw[name]] = value
    start, begin = np.zeros(1, np.int64), np.zeros((len(drives), 1, 2))
    on, rest_s = (drives[0] > 0).astype(float), np.zeros(SIZE)
    return run_free(drives, on, rest_s, np.tile(core, (len(drives), 1)), table, start, begin, 5.0, STEP_S)


@pytest.mark.parametrize("damping", [0.6, 1.0, 2.5])
@pytest.mark.parametrize("swapped", [0.0, 1.0])
def test_without_anything_free_two_lags_are_the_second_order(damping: float, swapped: float):
    own = run(drive()[None, :], (0.15, damping), SWAPPED=swapped)
    for found, asked in zip(own, boundary_states((0.15, damping), STEP_S, drive()[None, :]), strict=True):
        np.testing.assert_allclose(found, asked, atol=1e-9)


@pytest.mark.parametrize(
    "laws",
    [
        {"GATE_S": 0.02, "BEND": 3.0, "GATE_RATE": -0.5},
        {"FILL_S": 5.0, "EMPTY_S": 20.0, "GAIN": -0.4, "ZERO": 0.1, "BY_PULSES": 1.0},
    ],
)
def test_a_row_with_another_drive_is_as_if_run_alone(laws: dict[str, float]):
    """Where the rates do not depend on the drive itself, the shared transitions are exact."""
    other = 1.3 * drive()
    both = run(np.stack([drive(), other]), (0.15, 1.3), **laws)
    alone = run(other[None, :], (0.15, 1.3), **laws)
    np.testing.assert_allclose(both[0][1], alone[0][0], atol=1e-9)


def test_use_weakens_and_rest_brings_back():
    """By hand: held full work fills the state with its time constant."""
    held = np.full((1, SIZE), 5.0)
    torque = run(held, (0.02, 1.0), FILL_S=4.0, EMPTY_S=20.0, GAIN=-0.5, BY_PULSES=1.0)[0][0]
    seconds = STEP_S * np.arange(1, SIZE + 1)
    np.testing.assert_allclose(torque[41:], 5.0 * (1.0 - 0.5 * (1.0 - np.exp(-seconds / 4.0)))[40:], rtol=5e-3)


@named(("effect", "form"), FORMS)
def test_a_picture_is_finite_and_says_where_it_enters(effect, form: Form):
    start = {p.name: p.start[0] for p in form.parameters}
    shape = effect.shape(form, start)
    assert shape.enters in ("drive", "rate of rise", "rate of fall", "output", "zero")
    assert shape.driven_by in ("width", "activation", "torque", "time since", "sum of the past")
    assert shape.words.endswith(".") and shape.driver and shape.effect
    assert all(line.shape == shape.at.shape and np.isfinite(line).all() for line in shape.lines.values())


@pytest.mark.slow
def test_held_out_rows_end_the_search_and_never_choose_another(monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(free, "vetoed", lambda _before, after: asked.append(after.effects[-1][0]) or "no")
    with few_effects.only("free_gate", "free_level"):
        search, verdict = free.searched(*prepare(as_record(record_of_physics("physics", 0))))
    assert asked == ["free_gate"]
    assert not search.names("free") and verdict.kind == "unexplained_structure"


def test_held_out_rows_may_object_to_any_link_of_a_chain(monkeypatch: pytest.MonkeyPatch):
    """B, second best, is extended too; its own step from the base is asked about although B alone was not taken."""

    def model(name: str) -> SimpleNamespace:
        return SimpleNamespace(name=name, noise=SimpleNamespace(white_only=False), log_evidence=0.0)

    def longer(chain: free.Chain, *_: object) -> list[free.Chain]:
        further = {(): {"A": 1.0, "B": 0.8}, ("B",): {"C": 3.0}}.get(tuple(step.added for step in chain[1:]), {})
        return [(*chain, free.Step(name, model(name), "free", known=error)) for name, error in further.items()]

    monkeypatch.setattr(free, "_longer", longer)
    monkeypatch.setattr(free, "vetoed", lambda old, new: "no" if (old.name, new.name) == ("base", "B") else None)
    monkeypatch.setattr(free, "difference", lambda old, new: SimpleNamespace(gain=new - old, errors=10.0 * (new - old)))
    found = free._extended([(free.Step(None, model("base"), "base", known=0.0),)], silent, 0.0)
    assert [[step.added for step in chain[1:]] for chain in found] == [["A"]]


@cache
def found() -> tuple[Diagnosis, Improvement]:
    """Of a muscle of Ding's calcium and bridges."""
    with few_effects.only(*TRIED):
        return identify.diagnose_and_improve(as_record(record_of_physics("physics", 0)))


def unseen_error(model: Model, made: dict) -> float:
    """Over the noise, on the second record, without the zero that differs."""
    off = model.predict(as_record(made["unseen"])) - made["unseen"]["torque_nm"]
    return float(np.std(off - off[made["unseen"]["time_s"] < 1.9].mean()) / made["truth"]["noise_sd_nm"])


@pytest.mark.slow
def test_on_other_physics_a_free_effect_lowers_the_unseen_error_and_names_no_cause():
    made, (diagnosis, improvement) = record_of_physics("physics", 0), found()
    assert diagnosis.verdict == improvement.verdict == "unexplained_structure"
    assert [row for row in diagnosis.missing if row["probability"] >= 0.9 and row["effect"] != "catch_like"] == []
    assert diagnosis.free and diagnosis.free[0]["effect"] == improvement.steps[-1]["added"] == "free_gate"
    before, after = (unseen_error(model, made) for model in (improvement.models[0], improvement.models[-1]))
    assert after < 0.5 * before
    assert diagnosis.free[0]["words"] in improvement.steps[-1]["reason"]
    assert any(diagnosis.free[0]["words"] in line for line in diagnosis.plain)
    json.dumps(diagnosis.to_dict())


@pytest.mark.slow
def test_a_picture_has_bands_about_its_curves_and_stands_in_the_model():
    diagnosis, improvement = found()
    (row,) = diagnosis.free
    for line in row["lines"].values():
        lower, value, upper = (np.array(line[key]) for key in ("lower", "value", "upper"))
        assert len(value) == len(row["at"]) and np.all(lower <= upper + 1e-12)
        assert np.mean((lower - 1e-9 <= value) & (value <= upper + 1e-9)) > 0.9
    shape = improvement.models[-1].effects[-1]["shape"]
    assert shape["words"] == row["words"] and shape["lines"].keys() == row["lines"].keys()


@pytest.mark.slow
def test_a_model_with_a_free_effect_is_read_back_predicts_the_same_and_is_inverted():
    made, (_, improvement) = record_of_physics("physics", 0), found()
    model, unseen = improvement.models[-1], as_record(made["unseen"])
    again = Model.from_json(model.to_json())
    np.testing.assert_array_equal(again.predict(unseen), model.predict(unseen))
    wanted = 0.4 * np.max(model.recruitment.table()[1]) * np.sin(np.linspace(0.0, np.pi, 200)) ** 2
    inverted = invert(model, Reference.of(wanted))
    assert inverted.fit_percent is not None and inverted.fit_percent > 90.0


@pytest.mark.slow
def test_a_late_pulse_opens_a_gate_late_and_not_less():
    """A longer silence costs at least as much torque as a shorter one, however it came about."""
    model, each, slots = found()[1].models[-1], 40, 160
    times_s = np.arange(slots * each) / (40.0 * each)
    lowest_nm = []
    for late_ms, dropped in ((0.0, 0), (17.0, 0), (0.0, 1), (24.0, 1), (0.0, 2)):  # gaps of 25, 42, 50, 49 and 75 ms
        width_us = np.where(np.arange(slots) >= 20, 240.0, 0.0)
        width_us[101 : 101 + dropped] = 0.0
        late_s = np.where(np.arange(slots) == 100, late_ms / 1e3, 0.0)
        record = Record.from_arrays(times_s, np.repeat(width_us, each), 0.0 * times_s, late_s=np.repeat(late_s, each))
        lowest_nm.append(float(model.predict(record)[(times_s > 2.4) & (times_s < 2.9)].min()))
    full, late, one, late_one, two = lowest_nm
    assert full > late > one and abs(one - late_one) < 0.3 * (full - one) and one > two


def test_where_nothing_is_missing_nothing_free_is_added():
    record = hidden_muscles.record(seed=3, rate_hz=100)
    with few_effects.only(*(effect.id for effect in FREE), "fatigue"):
        diagnosis, improvement = identify.diagnose_and_improve(record)
        assert improvement.steps[1:] == () and diagnosis.free == ()
        grid, raw = prepare(record)
        search = search_effects(grid, raw, fitted_rows(grid, None))
        assert free.explain_freely(search, (), False, silent).names("free") == [], "nor where one is looked for"


def test_beside_a_free_effect_a_name_may_only_repair_its_form():
    drift = registry()["threshold_drift"]
    for there, repairs in (("free_strength", True), ("mixed_fibres", False)):
        model = SimpleNamespace(effects=[(there, registry()[there].forms[0])])
        assert resembles_earlier(model, drift, drift.forms[0].stage, []) is repairs, there


@pytest.mark.slow
def test_one_structure_is_one_model_whether_it_was_found_or_asked_for():
    record, (_, improvement) = as_record(record_of_physics("physics", 0)), found()
    wanted = [f"{effect['id']}:{effect['form']}" for effect in improvement.models[-1].effects]
    with few_effects.only(*TRIED):
        asked = identify.fit(record, effects=wanted)
    np.testing.assert_allclose(asked.predict(record), improvement.models[-1].predict(record), atol=2e-3)


@pytest.mark.slow
def test_zero_sign_scale_start_and_idle_pulses_change_no_free_effect():
    made = record_of_physics("physics", 0)
    counted = {"torque_nm": 2.0 - 0.3 * made["torque_nm"], "time_s": made["time_s"] + 1000.0}
    idle = {"pulse_width_us": np.maximum(made["pulse_width_us"], 1.0)}
    fits = [identify.fit(as_record(made | changes), effects=["free_gate"]).fit for changes in ({}, counted, idle)]
    plain, *others = (fit["held_out_rms_nm"] for fit in fits)
    assert [others[0] / 0.3, others[1]] == pytest.approx([plain, plain], rel=0.01)


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (["free_gate", "asymmetric_relaxation:by_drive"], "one would be ignored"),
        (["asymmetric_relaxation:by_drive", "free_gate"], "one would be ignored"),
        (["free_zero", "free_strength"], "or their slow state"),
    ],
)
def test_two_effects_of_which_one_would_be_ignored_are_refused(asked: list[str], says: str):
    with pytest.raises(BadRequest, match=says):
        identify.fit(hidden_muscles.record(seed=3, rate_hz=100), effects=asked)


@cache
def speedy() -> Model:
    return identify.fit(hidden_muscles.record(seed=3, rate_hz=100), effects=["free_speed:quick_first"])


def changed(model: Model, **values: float) -> Model:
    """With other parameters of its free effect."""
    (effect,) = model.effects
    parameters = {name: one | {"value": values.get(name, one["value"])} for name, one in effect["parameters"].items()}
    return model.with_(effects=({**effect, "parameters": parameters},))


def test_a_free_effect_whose_torque_would_run_away_is_not_usable():
    tame = speedy()
    assert _stable(tame)["passed"] and _stable(tame.with_(pulse_rate_hz=25.0))["passed"]
    assert isinstance(tame.linear, SecondOrder)
    wild = changed(
        tame.with_(linear=replace(tame.linear, time_constant_s=0.06, damping=0.5)),
        first_direction=-0.35, first_rising=-0.74, first_falling=0.0,
        second_direction=0.6, second_rising=0.66, second_falling=-0.15, coupling=0.86,
    )  # fmt: skip
    record = as_record(record_of_physics("physics", 0))
    grown_nm = problem_of(wild, make_grid(record))
    assert np.max(np.abs(grown_nm[0].at_samples(grown_nm[1]))) > 1e6, "it does run away"
    assert not _stable(wild)["passed"]
    with pytest.raises(BadModel, match="grows without limit"):
        wild.predict(record)


def test_effects_beside_discrete_dynamics_are_refused_and_not_left_out():
    record = hidden_muscles.record(seed=3, rate_hz=100)
    discrete = identify.fit(record, method="narx")
    assert isinstance(discrete.linear, Discrete)
    with pytest.raises(BadModel, match="only second-order dynamics"):
        discrete.with_(effects=speedy().effects).predict(record)


def test_no_dose_is_planned_for_a_muscle_that_hardly_answers(monkeypatch: pytest.MonkeyPatch):
    search: Any = SimpleNamespace(record=SimpleNamespace(angle_rad=None), last=None)
    verdict: Any = SimpleNamespace(kind="unexplained_structure")
    for passed in (True, False):
        quality = {"gates": {"torque": {"passed": passed}}}
        monkeypatch.setattr(result, "finish", lambda *_, quality=quality: SimpleNamespace(quality=quality))
        assert result._undecided(search, verdict) == passed


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda one: [one, one], "stands twice"),
        (lambda one: [{**one, "settings": one["settings"] | {"angle_late_s": "x"}}], "angle_late_s"),
        (lambda one: [{**one, "shape": one["shape"] | {"at": [0.0]}}], "shape.lines"),
        (lambda one: [{**one, "parameters": dict.fromkeys(one["parameters"], 0.1)}], "parameters"),
    ],
)
def test_a_model_whose_free_effect_cannot_be_run_is_refused(wrong, says: str):
    document = json.loads(speedy().to_json())
    document["effects"] = wrong(document["effects"][0])
    with pytest.raises(BadModel, match=says):
        Model.from_json(json.dumps(document)).predict(hidden_muscles.record(seed=3, rate_hz=100))
