"""The three quantities that are tracked, as stages of a simulation: they act on any model, with or without effects.

Gain and threshold may also move within a trial, in proportion to time, by `…_run` from its first to its last second;
the level is that in its middle. So may the zero of the torque.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects.base import Form, Parameter, Scene
from stimrig.identify.model import Model
from stimrig.identify.simulation.predict import problem_of
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.tracking.state import LEVELS


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


def _drift(_none: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    return p["drift_nm"] * _along(scene)


DRIFT = Form(
    "drift", "additive", "y + drift · share of time", (Parameter("drift_nm", "N·m", -100.0, 100.0),), _drift, True
)


def placed(model: Model, levels: np.ndarray, grid: Grid) -> tuple[Problem, np.ndarray]:
    """The approved model on a record, at such levels and curve, and its parameters.

    The first form is the gain, the last two are the shift and the drift.

    Parameters
    ----------
    model : Model
        The approved one.
    levels : ndarray, shape (3 + n,)
        Log gain, threshold shift (µs), log time scale, and what is added to the curve's coefficients (N·m).
    grid : Grid
        The record.

    Raises
    ------
    BadModel
        As `stimrig.identify.simulation.predict.problem_of`.
    """
    log_gain, shift_us, log_time = levels[:LEVELS].tolist()
    forms = ((GAIN, (log_gain, 0.0)), (SHIFT, (shift_us, 0.0)), (DRIFT, (0.0,)))
    problem, theta = problem_of(model, grid, forms)
    theta[0] += log_time
    theta[problem.coefficients] += levels[LEVELS:]
    return problem, theta
