"""The three quantities that are tracked, as stages of a simulation: they act on any model, with or without effects.

Gain and threshold may also move within a trial, in proportion to time, by `…_run` from its first to its last second;
the level is that in its middle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.dynamics.pulse_grid import Grid
from identify.effects.base import Form, Parameter, Scene
from identify.model import Model
from identify.simulation.predict import problem_of
from identify.simulation.problem import Problem
from identify.tracking.state import LEVELS, State


def _along(scene: Scene) -> np.ndarray:
    """-1/2 at the first interval, 1/2 at the last."""
    return (scene.time_s - scene.time_s[0]) / max(scene.span_s, 1e-9) - 0.5


def _shift(width_us: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    shift_us = p["threshold_shift_us"] + p["threshold_run_us"] * _along(scene)
    return np.where(width_us > 0.0, np.maximum(width_us - shift_us, 0.0), width_us)


def _gain(drive_nm: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return drive_nm * np.exp(p["gain_log"] + p["gain_run_log"] * _along(scene))


SHIFT = Form(
    "shift",
    "pulse_width",
    "w = f(u - shift) where u > 0",
    (Parameter("threshold_shift_us", "µs", -200.0, 200.0), Parameter("threshold_run_us", "µs", -50.0, 50.0)),
    _shift,
    True,
)
GAIN = Form(
    "gain",
    "gain",
    "w = gain · f(u)",
    (Parameter("gain_log", "1", -3.0, 3.0), Parameter("gain_run_log", "1", -1.0, 1.0)),
    _gain,
    True,
)


def placed(model: Model, expected: State, grid: Grid) -> tuple[Problem, np.ndarray]:
    """The approved model on a record as it is expected to be there, and its parameters: the gain first, the shift last.

    Raises
    ------
    BadModel
        As `identify.simulation.predict.problem_of`.
    """
    log_gain, shift_us, log_time = expected.mean[:LEVELS].tolist()
    problem, theta = problem_of(model, grid, ((SHIFT, (shift_us, 0.0)), (GAIN, (log_gain, 0.0))))
    theta[0] += log_time
    theta[problem.coefficients] += expected.curve_nm
    return problem, theta
