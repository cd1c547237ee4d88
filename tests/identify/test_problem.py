"""The engine against dense algebra, central differences and independent integration."""

from __future__ import annotations

import numpy as np
import pytest

from bench.muscles.hidden_records import generate
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.effect_fit import try_effect
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.noise import NoiseLevel, band_part, profile, whitened
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import Setup
from stimrig.identify.records.join import join
from tests.harness.carried_sessions import as_record
from tests.identify import hidden_muscles
from tests.identify.test_join import record


def _covariance(size: int, n: NoiseLevel) -> np.ndarray:
    lag = np.abs(np.arange(size)[:, None] - np.arange(size))
    band = n.band * n.decay**lag * np.cos(n.turn * lag)
    return n.sd_nm**2 * (n.share * n.ar1**lag + band + (1 - n.share - n.band) * np.eye(size))


@pytest.mark.parametrize(
    "noise", [*(NoiseLevel(0.7, share, 1.3) for share in (0.0, 0.6, 1.0)), NoiseLevel(0.8, 0.3, 1.0, 0.8, 0.97, 0.4)]
)
def test_whitening_is_that_of_the_dense_covariance(noise):
    rng = np.random.default_rng(2)
    rows = rng.standard_normal((3, 130))
    stretch = (np.array([0]), np.array([130]))
    white = whitened(rows, stretch, noise)
    dense = rows @ np.linalg.solve(_covariance(130, noise), rows.T)
    np.testing.assert_allclose(white @ white.T, dense, rtol=1e-6)
    if noise.band:
        gain = noise.band * noise.decay ** np.abs(np.arange(130)[:, None] - np.arange(130))
        gain = gain * np.cos(noise.turn * (np.arange(130)[:, None] - np.arange(130)))
        best = gain @ np.linalg.solve(_covariance(130, noise), rows[0])
        np.testing.assert_allclose(band_part(rows[0].copy(), stretch, noise), best, atol=1e-6)


def test_correlation_does_not_cross_a_gap():
    rows = np.random.default_rng(1).standard_normal((1, 60))
    noise = NoiseLevel(0.9, 0.7, 1.0)
    both = whitened(rows, (np.array([0, 40]), np.array([30, 60])), noise)
    first = whitened(rows, (np.array([0]), np.array([30])), noise)
    second = whitened(rows, (np.array([40]), np.array([60])), noise)
    np.testing.assert_allclose(both, np.c_[first, second])


@pytest.mark.parametrize("residual", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("wide", [True, False])
def test_of_a_residual_beyond_numbers_no_small_noise_is_said(residual, wide):
    row = np.full(40, residual)
    found, log_likelihood = profile(row, (np.array([0]), np.array([40])), NoiseLevel(0.5, 0.5, 1.0), wide)
    assert not found.sd_nm < np.inf
    assert not log_likelihood > -np.inf


@pytest.mark.parametrize(
    "names",
    [
        ["fatigue:fitness", "output_saturation:knee"],
        ["recruitment_hysteresis:two_curves", "electromechanical_delay:delay"],
        ["mixed_fibres:parallel", "baseline_drift:warming"],
        ["series_compliance:series"],
    ],
)
def test_derivatives_are_those_of_central_differences(names):
    record = hidden_muscles.record(seed=2, rate_hz=100)
    grid, _ = prepare(record)
    setup = fit_plain(grid, grid.fitted).problem.setup
    problem = Problem(setup, [(n.split(":")[0], find_effect(n.split(":")[0]).form(n.split(":")[1])) for n in names])
    values = np.r_[[0.2, 0.8, 0.001, 0.1, 0.5, 0.2], np.linspace(0, 6, setup.basis.size)]
    starts = [p.start[0] for c in problem.chosen for p in c.parameters]
    theta = problem.from_physical(np.r_[values, starts])
    places = [0, 1, 2, 3, 4, 5, 12, *range(problem.coefficients.stop, problem.size)]
    spans = np.clip(problem.upper - problem.lower, 1e-3, 100.0)
    assert_slopes(problem, theta, {place: 2e-5 * (1.0 if problem.log[place] else spans[place]) for place in places})


def assert_slopes(problem: Problem, theta: np.ndarray, steps: dict[int, float], share: float = 2e-3) -> None:
    """Derivatives are those of central differences, of the parameters at these places with these steps."""
    base, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None and slopes.shape == (problem.size, problem.setup.grid.size)
    np.testing.assert_array_equal(base, problem.run(theta)[0])
    for place, step in steps.items():
        ahead, back = theta.copy(), theta.copy()
        ahead[place] += step
        back[place] -= step
        central = (problem.run(ahead)[0] - problem.run(back)[0]) / (2 * step)
        scale = np.max(np.abs(central)) + 1e-6
        assert np.median(np.abs(slopes[place] - central)) < share * scale, problem.table[place].name


def test_a_form_whose_start_promises_little_is_followed_behind_forms_that_hardly_help():
    """Beside a spring of one stiffness the first step of one that stiffens promises a sixth of what it gains."""
    grid, _ = prepare(as_record(generate("series_compliance", "middle", 5, rate_hz=100)))
    found = try_effect(find_effect("series_compliance"), fit_plain(grid, grid.fitted))
    assert found is not None and found.form.name == "toe"
    assert found.gain > found.forms["series"] + 400


@pytest.fixture(scope="module")
def of_two_parts() -> Setup:
    """Two parts of six seconds."""
    grid, _ = prepare(join([record(400, name="a"), record(400, name="b", seed=2)], [0.0, 60.0]))
    return fit_plain(grid, grid.fitted).problem.setup


@pytest.mark.parametrize(
    ("effect", "share"), [("sensor_clipping:both", 2e-3), ("activation_dependent_speed:exponential", 3e-2), ("", 2e-3)]
)
def test_derivatives_on_two_parts_are_those_of_central_differences(of_two_parts: Setup, effect: str, share: float):
    """`share`: of coefficients of the curve; `run_core` leaves out that by their drive they change a speed, too."""
    name, _, form = effect.partition(":")  # "": the base
    problem = Problem(of_two_parts, [(name, find_effect(name).form(form))] if effect else [])
    states = [0.1, -0.2, 0.5, 0.2, -0.3, 0.4]
    starts = [p.start[0] for chosen in problem.chosen for p in chosen.parameters]
    physical = np.r_[0.25, 0.8, 0.001, states, np.linspace(0, 6, of_two_parts.basis.size), starts]
    theta = problem.from_physical(physical)
    np.testing.assert_allclose(problem.physical(theta), physical, rtol=1e-12)
    steps = {place: 0.1 * problem.step[place] for place in range(problem.size)}
    curve = range(problem.coefficients.start, problem.coefficients.stop)
    assert_slopes(problem, theta, {place: steps.pop(place) for place in curve}, share)
    assert_slopes(problem, theta, steps)
