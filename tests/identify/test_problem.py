"""The parameters of a problem on a record of two parts, and derivatives of stages that other tests leave out."""

from __future__ import annotations

import numpy as np
import pytest

from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S
from stimrig.identify.effects import get
from stimrig.identify.estimation.plain import fit_plain, prepare
from stimrig.identify.records.join import join
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.simulation.setup import Setup
from tests.identify.test_join import record


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Two parts of six seconds."""
    grid, _ = prepare(join([record(400, name="a"), record(400, name="b", seed=2)], [0.0, 60.0]))
    return fit_plain(grid, grid.fitted).problem.setup


def test_every_part_has_its_baseline_and_its_initial_state(setup: Setup):
    problem = Problem(setup, [("sensor_clipping", get("sensor_clipping").form("ceiling"))])
    coefficients = tuple(f"recruitment_{i}_nm" for i in range(setup.basis.size))
    assert problem.names[:-1] == (
        "time_constant_s", "damping", "delay_s", "baseline_nm", "baseline_2_nm",
        "initial_torque_nm", "initial_rate_nm_s", "initial_torque_2_nm", "initial_rate_2_nm_s", *coefficients,
    )  # fmt: skip
    assert problem.names[-1].startswith("sensor_clipping.")
    span_nm = 6.0 * setup.scale_nm
    table = {p.name: (p.lower, p.upper, p.scale, p.unit) for p in problem.table}
    assert table["time_constant_s"] == (*TIME_CONSTANT_BOUNDS_S, "log", "s")
    assert table["damping"] == (*DAMPING_BOUNDS, "log", "1")
    assert table["delay_s"] == (*setup.delay_bounds_s, "linear", "s")
    assert table["baseline_2_nm"] == (-span_nm, span_nm, "linear", "N·m")
    assert table["initial_torque_2_nm"] == (-span_nm, span_nm, "linear", "N·m")
    assert table["initial_rate_2_nm_s"] == (-10 * span_nm, 10 * span_nm, "linear", "N·m/s")
    assert table["recruitment_0_nm"] == (-np.inf, np.inf, "linear", "N·m")
    assert (problem.delay, problem.baselines, problem.initials) == (range(2, 3), range(3, 5), range(5, 9))
    assert problem.chosen[0].places == range(9 + setup.basis.size, problem.size)


@pytest.mark.parametrize("effect", ["sensor_clipping:both", "activation_dependent_speed:torque", ""])
def test_derivatives_on_two_parts_are_those_of_central_differences(setup: Setup, effect: str):
    name, _, form = effect.partition(":")  # "": the base
    problem = Problem(setup, [(name, get(name).form(form))] if effect else [])
    states = [0.1, -0.2, 0.5, 0.2, -0.3, 0.4]
    starts = [p.start[0] for chosen in problem.chosen for p in chosen.parameters]
    physical = np.r_[0.2, 0.8, 0.001, states, np.linspace(0, 6, setup.basis.size), starts]
    theta = problem.from_physical(physical)
    np.testing.assert_allclose(problem.physical(theta), physical, rtol=1e-12)
    base, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    assert slopes.shape == (problem.size, setup.grid.size)
    np.testing.assert_array_equal(base, problem.run(theta)[0])
    for place in range(problem.size):
        step = 0.1 * problem.step[place]
        ahead, back = theta.copy(), theta.copy()
        ahead[place] += step
        back[place] -= step
        central = (problem.run(ahead)[0] - problem.run(back)[0]) / (2 * step)
        scale = np.max(np.abs(central)) + 1e-6
        assert np.median(np.abs(slopes[place] - central)) < 2e-3 * scale, problem.table[place].name
