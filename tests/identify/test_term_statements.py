"""What a term says of itself: words with intervals, effects of the library that act like it, its course."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.dynamics.grid import make_grid
from stimrig.identify.dynamics.terms import Driver, Place
from stimrig.identify.effects import find_effect, registry
from stimrig.identify.effects.terms import BEHAVIOURS, _number, behaves_as
from stimrig.identify.estimation.shapes import _course, shape_of
from stimrig.identify.problem.predict import problem_of
from stimrig.identify.records.join import join
from tests.identify import hidden_muscles

DRAWS = np.r_[0.0, np.linspace(-1.0, 1.0, 401)][:, None]


@pytest.mark.parametrize(
    ("effect", "values", "words", "equation"),
    [
        (
            "free_width_by_torque",
            {"change": -0.53 + 0.07 * DRAWS, "lag_s": 0.25 + 0.06 * DRAWS},
            "Width that acts <- torque, 0.25 s late (0.19 to 0.31 s): -41 % at full torque (-44 to -37 %).",
            "u exp(z); z = -0.53·x, x' = (y/y_max - x)/0.25 s",
        ),
        (
            "free_factor_by_square",
            {"change": 0.9 + 0.2 * DRAWS},
            "Factor of the torque at the cell <- square of the torque: × 2.4 at full torque (2.0 to 2.8).",
            "y exp(z); z = 0.90·(y/y_max)²",
        ),
        (
            "free_second_rate_by_fall",
            {"change": 0.5 + 0.1 * DRAWS, "lag_s": 0.25 + 0.06 * DRAWS},
            "Rate of the second lag <- fall of the torque, 0.25 s late (0.19 to 0.31 s): +64 % at a fall by the "
            "largest torque in 0.1 s (+50 to +80 %).",
            "1/T2 exp(z); z = 0.50·x, x' = ((√(r² + 0.02²) + r - 0.02)/2 - x)/0.25 s; r = -y'·0.1 s/y_max",
        ),
        (
            "free_torque_by_width_play",
            {"change": 0.2 + 0.02 * DRAWS, "reach": 0.1 + 0.01 * DRAWS},
            "Torque at the cell <- width with play of ±10 % (9.1 to 11 %): +18 % of the largest at the largest width "
            "(+16 to +20 %).",
            "y + y_max z; z = 0.20·x, x follows u/u_max behind a play of ±0.10",
        ),
    ],
)
def test_words_give_place_driver_lag_and_size_with_intervals(effect, values, words, equation):
    described = find_effect(effect)
    shape = described.shape(described.forms[0], values)
    assert (shape.words, shape.equation) == (words, equation)
    assert all(np.isfinite(line).all() and line.shape == (402, shape.at.size) for line in shape.lines.values())


@pytest.mark.parametrize(
    ("value", "words"), [(9.96, "+10"), (0.0996, "+0.10"), (-99.6, "-100"), (0.0, "+0.0"), (4.44, "+4.4")]
)
def test_a_number_has_two_digits_where_rounding_adds_one_too(value, words):
    assert _number(value, "+") == words


def test_the_picture_of_a_play_has_a_rising_and_a_falling_line_a_reach_apart():
    term = find_effect("free_torque_by_width_play")
    shape = term.shape(term.forms[0], {"change": 0.2 + 0.0 * DRAWS, "reach": 0.1 + 0.0 * DRAWS})
    middle = np.searchsorted(shape.at, 0.5)
    ends = {name: (lines[0, 0], lines[0, middle], lines[0, -1]) for name, lines in shape.lines.items()}
    assert ends["rising"] == pytest.approx((0.0, 0.08, 0.18)) and ends["falling"] == pytest.approx((0.02, 0.12, 0.18))


@pytest.mark.parametrize(
    ("change", "lag_s", "said"),
    [(0.5, 0.3, ""), (-3.0, 0.3, "its size"), (0.5, 30.0, "its lag"), (3.0, 0.02, "its size and its lag")],
)
def test_a_term_at_the_bound_of_its_search_says_so(change, lag_s, said):
    term = find_effect("free_width_by_torque")
    bounds = {p.name: (p.lower, p.upper) for p in term.forms[0].parameters}
    drawn = {"change": change + 0.1 * DRAWS, "lag_s": lag_s * (1.0 + 0.1 * DRAWS)}
    values = {name: np.clip(value, *bounds[name]) for name, value in drawn.items()}
    ending = f"At the bound of what is tried: {said}." if said else "%)."
    assert term.shape(term.forms[0], values).words.endswith(ending)


@pytest.mark.parametrize(
    ("place", "driver", "size", "lag_s", "effects"),
    [
        (Place.STRENGTH, Driver.DRIVE, -0.5, 20.0, ("fatigue",)),
        (Place.STRENGTH, Driver.DRIVE, 0.5, 20.0, ("potentiation",)),
        (Place.STRENGTH, Driver.DRIVE, 0.0, 20.0, ()),
        (Place.SECOND_RATE, Driver.FALL, 0.5, 0.1, ("asymmetric_relaxation",)),
        (Place.TORQUE, Driver.TORQUE_PLAY, 0.5, 0.0, ()),
    ],
)
def test_a_term_behaves_as_an_effect_of_the_library_or_as_none(place, driver, size, lag_s, effects):
    assert behaves_as(place, driver, size + 0.1 * DRAWS, lag_s) == effects
    assert {row[0] for row in BEHAVIOURS} <= registry().keys()


@pytest.mark.parametrize("driver", Driver)
def test_the_course_of_a_factor_is_that_by_which_the_model_changes_the_torque(driver):
    """A play begins anew with each part of a joined record."""
    record = hidden_muscles.record(rate_hz=100)
    if driver > Driver.SQUARE:
        record = join([record, hidden_muscles.record(seed=2, rate_hz=100)], [0.0, 600.0])
    effect, values = f"free_factor_by_{driver.name.lower()}", (-0.5, 0.4 if driver > Driver.SQUARE else 0.5)
    names = [parameter.name for parameter in find_effect(effect).forms[0].parameters]
    parameters = {name: {"value": value, "sd": 0.0} for name, value in zip(names, values, strict=False)}
    term = {"id": effect, "form": "term", "parameters": parameters, "settings": {"scale_nm": 6.0}}
    model = identify.fit(record).with_(effects=(term,))
    problem, theta = problem_of(model, make_grid(record))
    fitted = Mock(problem=problem, theta=theta, physical=problem.physical(theta))
    course, without = _course(fitted, problem.chosen[0]), theta.copy()
    without[problem.chosen[0].first] = 0.0
    zero = problem.physical(theta)[problem.baselines][problem.setup.grid.part]
    changed, torque = (problem.run(at)[0] - zero for at in (theta, without))
    times_s, working = problem.setup.scene.time_s, torque > 1.0
    expected = np.interp(times_s[working], course["time_s"], course["value"])
    if driver > Driver.SQUARE:
        begun_s = times_s[problem.setup.grid.starts[1]] + problem.setup.grid.start_s
        assert course["value"][np.searchsorted(course["time_s"], begun_s)] == 1.0
    off = np.abs(changed[working] / torque[working] - expected)  # a course of few points misses where a driver jumps
    assert np.median(off) < 0.01 and np.mean(off) < 0.03 and np.min(expected) < 0.95
    if driver == Driver.TORQUE:
        assert np.max(off) < 0.015 and np.min(expected) < 0.7


@pytest.mark.parametrize(("sizes", "cancel"), [((-0.8, 0.8), True), ((0.8, 0.8), False), ((-0.8, 0.2), False)])
@pytest.mark.parametrize("second", ["free_strength_by_torque", "free_factor_by_torque"])
def test_a_term_that_another_nearly_cancels_is_told_only_with_it(sizes, cancel, second):
    """Drive and torque, each behind 20 s, have about the same course: what the first does alone is no fatigue."""
    record, terms = hidden_muscles.record(rate_hz=100), ("free_strength_by_drive", second)
    entries = [
        {"id": effect, "form": "term", "settings": {"scale_nm": 6.0}}
        | {"parameters": {"change": {"value": size, "sd": 0.0}, "lag_s": {"value": 20.0, "sd": 0.0}}}
        for effect, size in zip(terms, sizes, strict=True)
    ]
    problem, theta = problem_of(identify.fit(record).with_(effects=tuple(entries)), make_grid(record))
    fitted = Mock(problem=problem, theta=theta, physical=problem.physical(theta))
    for index, other in enumerate((f"“{registry()[second].name}”", "“Strength by drive”")):
        shape = shape_of(fitted, index, 1e-6 * np.eye(theta.size))
        assert (f"It counts only together with {other}" in shape["words"]) == cancel
        assert bool(shape["behaves_as"]) != cancel
