"""Free effects: terms are what their words say, are found on other physics, and absent where nothing is missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.muscles.physics_records import record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import candidate_terms, free, result
from stimrig.identify.diagnosis.search import resembles_earlier, search_effects, silent
from stimrig.identify.diagnosis.verdict import judge
from stimrig.identify.dynamics.linear import Discrete
from stimrig.identify.dynamics.second_order import boundary_states
from stimrig.identify.dynamics.terms import LARGEST, REACH, Driver, Place, lags_of, run_terms
from stimrig.identify.effects import registry
from stimrig.identify.effects.terms import DRIVERS, PLACES
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.estimation.candidates import likelihood_warnings
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.quality import _stable
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.estimation.solve import solve
from stimrig.identify.inversion import Reference, invert
from stimrig.identify.model import Model
from stimrig.identify.noise import WHITE, beside_zero
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import Setup
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from stimrig.identify.results import Diagnosis, Improvement
from stimrig.identify.tracking import Outcome, follow
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.identify import hidden_muscles
from tests.identify.test_join import record as short_record

STEP_S, SIZE, FULL_NM = 0.025, 400, 5.0
FREE = [effect for effect in registry().values() if effect.shape]
TRIED = "free_width_by_torque", "free_torque_by_pulses", "free_strength_by_drive", "asymmetric_relaxation"
PARALLEL = {
    name: {"value": value, "sd": 0.1, "unit": "1"}
    for name, value in (("slow_share", 0.3), ("ratio", 3.0), ("order", 0.5))
}


def run(
    width: np.ndarray,
    *terms: tuple[Place, Driver, float, float],
    damping: float = 1.0,
    rest_s: float = 0.0,
    begins: tuple[int, ...] = (0,),
):
    """Torque and rate of a muscle whose curve is straight, with terms of (place, driver, size, lag); rests halfway."""
    places, drivers = (np.array([term[i] for term in terms], np.int64) for i in range(2))
    sizes, lag = (np.array([term[i] for term in terms], float) for i in (2, 3))
    curve, own, rests_s = np.linspace(0.0, REACH * FULL_NM, 271), np.full((len(terms), 2), -1), np.zeros(width.size)
    rests_s[SIZE // 2] = rest_s
    return run_terms(
        FULL_NM * width, np.zeros((0, width.size)), width, np.zeros((0, width.size)), (width > 0).astype(float),
        rests_s, curve, np.zeros((0, 271)), np.zeros(0, np.int64), lags_of(0.15, damping)[0], np.zeros((0, 3)),
        places, drivers, sizes, lag, own, np.array(begins), np.zeros((len(begins), 2)),
        np.zeros((0, len(begins), 2)), FULL_NM, STEP_S,
    )[:2]  # fmt: skip


@pytest.mark.parametrize("damping", [0.6, 1.0, 2.5])
def test_without_a_term_two_lags_are_the_second_order(damping: float):
    width = np.repeat(np.random.default_rng(0).choice([0.0, 0.2, 0.6, 1.0], SIZE // 20), 20)
    exact = boundary_states((0.15, damping), STEP_S, FULL_NM * width[None, :])
    for value, right, away in zip(run(width, damping=damping), exact, (0.004, 0.04), strict=True):
        np.testing.assert_allclose(value, right[0], atol=away * np.ptp(right))


@pytest.mark.parametrize("place", Place)
def test_a_term_that_pulses_fill_is_what_its_place_says(place: Place):
    """By hand: under held pulses the exponent is size (1 - exp(-t/lag))."""
    torque_nm = run(np.full(SIZE, 0.5), (place, Driver.PULSES, 0.3, 4.0))[0][1:]
    z = 0.3 * -np.expm1(-STEP_S * np.arange(1, SIZE + 1) / 4.0)
    expected = {Place.TORQUE: 2.5 + FULL_NM * z, Place.FIRST_RATE: 2.5, Place.SECOND_RATE: 2.5}
    usual = 2.5 * np.exp(LARGEST * np.tanh(z / LARGEST))
    np.testing.assert_allclose(torque_nm[320:], np.broadcast_to(expected.get(place, usual), SIZE)[320:], rtol=5e-3)


@pytest.mark.parametrize("driver", [driver for driver in Driver if driver < Driver.SQUARE])
def test_a_rest_without_samples_lets_a_term_decay_as_recorded_rest_does(driver: Driver):
    width, term = np.r_[np.ones(40), np.zeros(160), np.full(200, 0.6)], (Place.STRENGTH, driver, -0.8, 6.0)
    rested = run(np.insert(width, SIZE // 2, np.zeros(120)), term)[0][-200:]
    np.testing.assert_allclose(run(width, term, rest_s=120 * STEP_S)[0][-200:], rested, atol=1e-6)
    assert np.max(np.abs(run(width, term)[0][-200:] - rested)) > 1e-3


@pytest.mark.parametrize("driver", [Driver.TORQUE_PLAY, Driver.WIDTH_PLAY])
def test_a_play_begins_anew_with_each_part_as_in_an_unseen_record(driver: Driver):
    half, term = np.r_[np.ones(SIZE // 4), np.zeros(SIZE // 4)], (Place.TORQUE, driver, 0.3, 0.2)
    first, second = np.split(run(np.r_[half, half], term, begins=(0, half.size))[0][1:], 2)
    np.testing.assert_array_equal(second[:-1], first[:-1])


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Two parts of four seconds with a pause."""
    grid, _ = prepare(join([short_record(400, name="a"), short_record(400, name="b", seed=2)], [0.0, 60.0]))
    return fit_plain(grid, grid.fitted).problem.setup


@pytest.mark.parametrize("names", [*([effect.id] for effect in FREE), ["free_width_by_torque", "threshold_drift"]])
def test_every_derivative_is_that_of_central_differences(setup: Setup, names: list[str]):
    """At a time constant at which all curves are read in one way; at size zero nothing changes, bit for bit."""
    problem = Problem(setup, [(name, registry()[name].forms[0]) for name in names])
    values = [p.start[0] or 0.3 for chosen in problem.chosen for p in chosen.parameters]
    usual = np.r_[0.15, 0.8, 0.001, 0.1, -0.2, 0.5, 0.2, -0.3, 0.4, np.linspace(0.0, 6.0, setup.basis.size)]
    theta = problem.from_physical(np.r_[usual, values])
    slopes = problem.run(theta, derivatives=True)[1]
    assert slopes is not None
    loose = 1e-2 if names[0].endswith("_play") else 1e-3
    for place, step in enumerate(0.1 * problem.step):
        ahead, back = (problem.run(theta + sign * step * (np.arange(theta.size) == place))[0] for sign in (1.0, -1.0))
        central = (ahead - back) / (2.0 * step)
        np.testing.assert_allclose(
            slopes[place], central, atol=loose * np.max(np.abs(central)), err_msg=problem.names[place]
        )
    problem, theta = Problem(setup, problem.effects[:1]), theta[: problem.chosen[0].places.stop]
    theta[usual.size] = 0.0
    np.testing.assert_array_equal(problem.run(theta)[0], Problem(setup, []).run(theta[: usual.size])[0])


@pytest.mark.parametrize("effect", FREE, ids=lambda effect: effect.id)
def test_a_picture_is_finite_and_says_where_it_enters(effect):
    (form,) = effect.forms
    shape = effect.shape(form, {p.name: np.full((2, 1), p.start[0] or 0.2) for p in form.parameters})
    assert shape.place in {row[0] for row in PLACES.values()}
    assert shape.driven_by in {row[0] for row in DRIVERS.values()}
    assert shape.words.endswith(".") and shape.driver and shape.effect
    assert all(line.shape == (2, shape.at.size) and np.isfinite(line).all() for line in shape.lines.values())


def strange(**changes: Any) -> Record:
    """A muscle that shortens under its electrode."""
    return as_record(shortening() | changes)


@cache
def shortening() -> dict[str, Any]:
    return record_of_physics("places", 1, (), protocol="levels")


@cache
def found() -> tuple[Diagnosis, Improvement]:
    with few_effects.only(*TRIED):
        diagnoses, improvement = identify.diagnose_and_improve(strange())
        return diagnoses[0], improvement


def unseen_error(model: Model) -> float:
    """Over the noise, on the second record."""
    unseen = shortening()["unseen"]
    return float(np.std(model.predict(as_record(unseen)) - unseen["torque_nm"]) / shortening()["truth"]["noise_sd_nm"])


@pytest.mark.slow
def test_on_other_physics_a_term_says_where_lowers_the_unseen_error_and_names_no_cause():
    diagnosis, improvement = found()
    assert diagnosis.verdict == improvement.verdict == "unexplained_structure"
    assert [row for row in diagnosis.missing if row["probability"] >= 0.9] == []
    (row,) = diagnosis.free
    assert row["effect"] == improvement.steps[-1]["added"] == "free_width_by_torque"
    assert [row["place"]] == shortening()["truth"]["place"] and row["driven_by"] == "torque"
    assert -0.3 < row["parameters"]["change"]["value"] < -0.15
    assert unseen_error(improvement.models[0]) > 4.0 and unseen_error(improvement.models[-1]) < 0.5
    assert row["words"] in improvement.steps[-1]["reason"]
    assert row["words"] in str(diagnosis)
    json.dumps(diagnosis.to_dict())
    for line in row["lines"].values():
        lower, value, upper = (np.array(line[key]) for key in ("lower", "value", "upper"))
        assert len(value) == len(row["at"]) and np.all(lower <= upper + 1e-12)
        assert np.mean((lower - 1e-9 <= value) & (value <= upper + 1e-9)) > 0.9
    assert improvement.models[-1].effects[-1]["shape"]["lines"].keys() == row["lines"].keys()


@pytest.mark.slow
def test_a_model_with_a_term_is_read_back_fitted_again_inverted_and_followed():
    model, unseen = found()[1].models[-1], as_record(shortening()["unseen"])
    again = Model.from_json(model.to_json())
    np.testing.assert_array_equal(again.predict(unseen), model.predict(unseen))
    fitted = identify.fit(strange(), effects=["free_width_by_torque"])
    np.testing.assert_allclose(fitted.predict(unseen), model.predict(unseen), atol=0.015)  # the search's noise is white
    wanted = 0.4 * np.max(model.recruitment.table()[1]) * np.sin(np.linspace(0.0, np.pi, 200)) ** 2
    inverted = invert(model, Reference.of(wanted))
    assert inverted.fit_percent is not None and inverted.fit_percent > 90.0
    step = follow(model, None, as_record(shortening()["unseen"] | {"segment": np.full(unseen.time_s.size, "trial")}))
    assert step.outcome == Outcome.FOLLOWED and np.max(np.abs(step.after.mean[[0, 2]])) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        lambda made: {"torque_nm": 2.0 - 0.3 * made["torque_nm"], "time_s": made["time_s"] + 1000.0},
        lambda made: {"pulse_width_us": np.maximum(made["pulse_width_us"], 1.0)},
        lambda made: {key: made[key][::2] for key in ("time_s", "pulse_width_us", "torque_nm", "segment")},
    ],
    ids=["zero, sign, scale and start", "idle pulses", "rate"],
)
def test_how_a_record_is_counted_changes_no_term(changes):
    with few_effects.only(*TRIED):
        (row,) = identify.diagnose(strange(**changes(shortening()))).free
    (plain,) = found()[0].free
    assert row["effect"] == plain["effect"]
    for name, number in plain["parameters"].items():
        assert row["parameters"][name]["value"] == pytest.approx(number["value"], rel=0.03), name


@pytest.mark.slow
def test_no_terms_are_taken_where_held_out_rows_speak_against_each(monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(free, "vetoed", lambda _before, after: asked.append(after.effects[-1][0]) or "no")
    with few_effects.only(*TRIED):
        search = free.search_record(strange())
    assert asked[0] == "free_width_by_torque" and len(asked) == len({*asked})
    assert not search.names("free") and judge(search).kind == "unexplained_structure"


def test_a_model_has_no_more_terms_than_are_allowed_however_often_it_is_searched(monkeypatch: pytest.MonkeyPatch):
    grid, _ = prepare(strange())
    plain = fit_plain(grid, fitted_rows(grid, None))
    plain = solve(plain.problem, plain.theta, WHITE)
    monkeypatch.setattr(candidate_terms, "MAX_TERMS", 1)
    one = candidate_terms.fit_term(plain, *candidate_terms.promising(plain)[0])
    assert candidate_terms.promising(one) == []


def efforts() -> Record:
    """Two half sines while the muscle pulls, and none at rest."""
    record = hidden_muscles.record(seed=3, rate_hz=100)
    arches = (np.sin(np.pi * np.clip((record.time_s - begin_s) / 1.5, 0.0, 1.0)) for begin_s in (4.0, 9.0))
    return record.with_torque(record.torque_nm + sum(arches))


@pytest.mark.parametrize(("make", "refused"), [(strange, True), (efforts, False)])
def test_efforts_at_work_are_refused_where_a_term_predicts_better(make: Callable[[], Record], refused: bool):
    grid, raw = prepare(make())
    with few_effects.only("voluntary_effort", "free_width_by_torque"):
        search = search_effects(grid, raw, fitted_rows(grid, None))
    assert search.names("library") == ([] if refused else ["voluntary_effort"])
    (effort,) = search.rounds[0]
    assert ("width by torque predicts better" in (effort.refusal or "")) is refused


def test_where_nothing_is_missing_nothing_free_is_added():
    record = hidden_muscles.record(seed=3, rate_hz=100)
    with few_effects.only(*(effect.id for effect in FREE), "fatigue"):
        (diagnosis,), improvement = identify.diagnose_and_improve(record)
        assert improvement.steps[1:] == () and diagnosis.free == ()
        grid, raw = prepare(record)
        search = search_effects(grid, raw, fitted_rows(grid, None))
        assert free.explain_freely(search, (), silent).names("free") == [], "nor where one is looked for"


def test_beside_a_free_effect_a_name_may_only_repair_its_form():
    drift = registry()["threshold_drift"]
    for there, repairs in (("free_strength_by_drive", True), ("mixed_fibres", False)):
        model = SimpleNamespace(effects=[(there, registry()[there].forms[0])])
        assert resembles_earlier(model, drift, drift.forms[0].stage, []) is repairs, there


@pytest.mark.parametrize("other", ["asymmetric_relaxation:by_drive", "mixed_fibres"])
@pytest.mark.parametrize("order", [1, -1])
def test_two_effects_of_which_one_would_be_ignored_are_refused(other: str, order: int):
    with pytest.raises(BadRequest, match="both set the lags: one would be ignored"):
        identify.fit(hidden_muscles.record(seed=3, rate_hz=100), effects=["free_width_by_torque", other][::order])


@cache
def with_term() -> Model:
    return identify.fit(hidden_muscles.record(seed=3, rate_hz=100), effects=["free_strength_by_torque"])


def changed(entry: dict[str, Any], **changes: Any) -> list[dict[str, Any]]:
    return [{**entry, **{key: entry[key] | value for key, value in changes.items()}}]


def test_a_term_by_which_the_torque_would_feed_itself_is_not_usable():
    tame = with_term()
    assert _stable(tame)["passed"] and _stable(tame.with_(pulse_rate_hz=25.0))["passed"]
    assert not _stable(tame.with_(effects=changed(tame.effects[0], parameters={"change": {"value": 2.5}})))["passed"]


def test_effects_beside_discrete_dynamics_are_refused_and_not_left_out():
    record = hidden_muscles.record(seed=3, rate_hz=100)
    discrete = identify.fit(record, method="narx")
    assert isinstance(discrete.linear, Discrete)
    with pytest.raises(BadModel, match="only second-order dynamics"):
        discrete.with_(effects=with_term().effects).predict(record)


def test_no_dose_is_planned_for_a_muscle_that_hardly_answers(monkeypatch: pytest.MonkeyPatch):
    search: Any = SimpleNamespace(record=SimpleNamespace(angle_rad=None), last=None)
    verdict: Any = SimpleNamespace(kind="unexplained_structure")
    for passed in (True, False):
        quality = {"gates": {"torque": {"passed": passed}}}
        monkeypatch.setattr(result, "finish", lambda *_, quality=quality: SimpleNamespace(quality=quality))
        assert result._undecided(search, verdict, False) == passed


@pytest.mark.parametrize(("noises", "planned", "wanted"), [(2.0, False, True), (1.1, False, False), (2.0, True, False)])
def test_a_further_test_is_planned_beside_a_name_that_leaves_more_than_noise(
    setup: Setup, monkeypatch: pytest.MonkeyPatch, noises: float, planned: bool, wanted: bool
):
    """Unless one is planned that tells the name from its rivals."""
    quality = {"gates": {"torque": {"passed": True}}}
    monkeypatch.setattr(result, "finish", lambda *_: SimpleNamespace(quality=quality))
    last: Any = SimpleNamespace(
        problem=SimpleNamespace(setup=setup), noise=WHITE, rms_nm=noises * setup.grid.mean_noise_nm(setup.fitted)
    )
    search: Any = SimpleNamespace(record=setup.grid.record, last=last, residual=SimpleNamespace(significant=False))
    search.names, search.remainder = lambda *_: ["fatigue"], SimpleNamespace(held_out=None)
    verdict: Any = SimpleNamespace(kind="effect_missing", objections={})
    assert result._undecided(search, verdict, planned) is wanted
    search.names = lambda *_: ["fatigue", "voluntary_effort"]  # efforts leave more on rows that were not fitted
    assert not result._undecided(search, verdict, planned)
    verdict.objections = {"voluntary_effort": "held out, the error rises"}  # in a further test it does not come again
    assert result._undecided(search, verdict, planned) is not planned


@pytest.mark.parametrize(("zero_nm", "held"), [(0.0, False), (0.2, True), (-0.2, True)])
def test_a_zero_that_moves_from_rest_to_rest_is_held_as_slow_noise(zero_nm: float, held: bool):
    """Else terms would take it up; the rest of the error stays white, however slow it is."""
    record = hidden_muscles.record(rate_hz=100)
    moving = zero_nm * np.sin(0.17 * record.time_s)
    grid, _ = prepare(record.with_torque(record.torque_nm + moving))
    held_model = candidate_terms.fix_noise(fit_plain(grid, fitted_rows(grid, None)))
    noise, said = held_model.noise, " ".join(likelihood_warnings(held_model))
    assert ("white, beside a zero that wanders by" in said) is held
    assert noise.held and not noise.at_bound and (noise.share > 0.0) is held
    if held:
        assert 0.5 < noise.sd_nm * noise.share**0.5 / np.std(moving) < 1.5


@pytest.mark.parametrize(("error_nm", "white_nm2"), [(0.5, 0.21), (0.1, 0.0025)])
def test_beside_a_zero_the_rest_of_the_error_is_white_and_a_quarter_of_it_at_least(error_nm: float, white_nm2: float):
    noise = beside_zero(0.2, error_nm, 20.0, STEP_S)
    assert (1.0 - noise.share) * noise.sd_nm**2 == pytest.approx(white_nm2)
    assert noise.share * noise.sd_nm**2 == pytest.approx(0.04) and noise.ar1 == pytest.approx(np.exp(-STEP_S / 20.0))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda one: [one, one], "stands twice"),
        (lambda one: [one, {**one, "id": "mixed_fibres", "form": "ordered", "parameters": PARALLEL}], "sets the lags"),
        (lambda one: changed(one, settings={"angle_late_s": "x"}), "angle_late_s"),
        (lambda one: changed(one, shape={"at": [0.0]}), "shape.lines"),
        (lambda one: [{**one, "parameters": dict.fromkeys(one["parameters"], 0.1)}], "parameters"),
        (lambda one: [{**one, "id": "free_gate"}], "free effects are terms now. Fit the record again"),
    ],
)
def test_a_model_whose_free_effect_cannot_be_run_is_refused(wrong, says: str):
    document = json.loads(with_term().to_json())
    document["effects"] = wrong(document["effects"][0])
    with pytest.raises((BadModel, BadRequest), match=says):
        Model.from_json(json.dumps(document)).predict(hidden_muscles.record(seed=3, rate_hz=100))


@pytest.mark.parametrize(
    ("extra", "begins"),
    [
        ({"begun_with": []}, []),
        ({"begun_with": ["fatigue:fitness"], "step": 0.5}, ["fatigue:fitness"]),
        ({"begun_with": ["fatigue:fitness"] * 1000}, ["fatigue:fitness"]),
        ({"begun_with": ["output_saturation:knee"]}, ["fatigue:fitness"]),
        ({"begun_with": ["no_such_effect"]}, ["fatigue:fitness"]),
        ({}, ["fatigue:fitness"]),
    ],
)
def test_a_model_names_only_a_search_that_may_contain_it(
    extra: dict[str, Any], begins: list[str], monkeypatch: pytest.MonkeyPatch
):
    diagnosis = import_module("stimrig.identify.diagnosis")
    step, asked = SimpleNamespace(structure=["fatigue:fitness"]), []
    whole: Any = SimpleNamespace(steps=[SimpleNamespace(structure=[]), step], from_step=lambda number: number)
    monkeypatch.setattr(diagnosis, "structure_of", lambda _model: ["fatigue:fitness"])
    monkeypatch.setattr(diagnosis, "same_data", lambda *_: True)
    monkeypatch.setattr(diagnosis, "search_record", lambda _r, _p, structure: asked.append([*structure]) or whole)
    model: Any = SimpleNamespace(extra=extra)
    record: Any = None
    found = diagnosis.search_for(record, model)
    assert asked[0] == begins
    assert (found == 1) is (begins == [])
