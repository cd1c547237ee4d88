"""Who is compared: ours, peers from PyPI, and the oracle. Each fits the same rows and predicts free-run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from stimrig import identify
from stimrig.identify.records.record import Record
from tests.harness.muscle import second_order, sigmoid

PULSE_RATE_HZ = 40.0
SPLINES = 8


@dataclass(frozen=True)
class Task:
    """One record.

    Parameters
    ----------
    record : Record
        PRBS and ramp with rests, then `validate` (multi-level, unseen), then rest.
    fitted : int
        Number of leading samples that may be fitted: all before `validate`.
    """

    record: Record
    fitted: int

    @property
    def rate_hz(self) -> float:
        return round(self.record.sample_rate_hz, 3)


@dataclass(frozen=True)
class Contender:
    """A name, where it is from, how it fits: a task in, free-run torque for all samples out."""

    name: str
    what: str
    fit: Callable[[Task], Callable[[], np.ndarray]]


def spline_inputs(width_us: np.ndarray) -> np.ndarray:
    """Cubic B-splines of the pulse width, zero at zero, shape (N, SPLINES): recruitment for linear packages."""
    inner = np.linspace(0.0, 300.0, SPLINES - 1)
    knots = np.r_[[0.0] * 3, inner, [300.0] * 3]
    return BSpline(knots, np.eye(SPLINES + 1), 3)(np.clip(width_us, 0.0, 300.0))[:, 1:]


def ours(task: Task) -> Callable[[], np.ndarray]:
    model = identify.fit(task.record)
    return lambda: identify.predict(model, task.record)


def ours_two_stage(task: Task) -> Callable[[], np.ndarray]:
    model = identify.fit(task.record, method="two-stage")
    return lambda: identify.predict(model, task.record)


def oracle(task: Task) -> Callable[[], np.ndarray]:
    """scipy's least squares on the five true parameters, from a start that is 20 % off."""
    width, rate = task.record.pulse_width_us, task.rate_hz

    def simulate(x: np.ndarray) -> np.ndarray:
        gain, steep, middle, period, damping = x
        drive = sigmoid(width, gain, steep, np.exp(min(steep * middle, 600.0)))
        return second_order(drive, period, damping, rate)

    measured = task.record.torque_nm[: task.fitted]
    start = np.array([6.9 * 1.2, 0.041 * 0.8, 190.0 * 1.1, 0.5284 * 0.8, 0.6369 * 1.2])
    found = least_squares(lambda x: simulate(x)[: task.fitted] - measured, start, x_scale=np.abs(start), xtol=1e-10)
    return lambda: simulate(found.x)


def sippy(task: Task) -> Callable[[], np.ndarray]:
    """N4SID of order 2 on the PRBS, then the spline by least squares through what it found.

    With the splines as inputs of one N4SID it runs away: two levels of a PRBS don't excite ten inputs.
    """
    from sippy_unipi import system_identification

    names = np.array(task.record.segment_names)[task.record.segment]
    last = int(np.flatnonzero(names == "prbs")[-1]) + 1
    level = (task.record.pulse_width_us > 0).astype(float)
    found = system_identification(
        task.record.torque_nm[None, :last], level[None, :last], "N4SID", SS_fixed_order=2, SS_A_stability=True
    )
    inputs = spline_inputs(task.record.pulse_width_us)

    def respond(columns: np.ndarray) -> np.ndarray:
        state, response = np.zeros((2, columns.shape[1])), np.empty_like(columns)
        for k, u in enumerate(columns):
            response[k] = (found.C @ state + found.D * u)[0]
            state = found.A @ state + found.B * u
        return response

    columns = respond(inputs)
    weights = np.linalg.lstsq(columns[: task.fitted], task.record.torque_nm[: task.fitted], rcond=None)[0]
    return lambda: columns @ weights


def jax_sysid(task: Task) -> Callable[[], np.ndarray]:
    """Two states, spline inputs, L-BFGS."""
    import jax
    from jax_sysid.models import LinearModel

    jax.config.update("jax_enable_x64", True)
    inputs = spline_inputs(task.record.pulse_width_us)
    measured = task.record.torque_nm[: task.fitted]
    scale = float(np.std(measured))
    model = LinearModel(2, 1, SPLINES, feedthrough=False)
    model.loss(rho_x0=1e-3, rho_th=1e-9)
    model.optimization(adam_epochs=0, lbfgs_epochs=3000, iprint=-1)
    model.fit(measured[:, None] / scale, inputs[: task.fitted])
    return lambda: np.asarray(model.predict(np.zeros((2, 1)), inputs)[0]).ravel() * scale


def sysidentpy(task: Task) -> Callable[[], np.ndarray]:
    """FROLS on spline inputs with extended least squares, scored in free run."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    inputs = spline_inputs(task.record.pulse_width_us)
    measured = task.record.torque_nm[: task.fitted]
    model = FROLS(
        ylag=2,
        xlag=[[1, 2]] * SPLINES,
        elag=2,
        info_criteria="bic",
        n_info_values=23,
        estimator=LeastSquares(unbiased=True),
        basis_function=Polynomial(degree=1),
        model_type="NARMAX",
    )
    model.fit(X=inputs[: task.fitted], y=measured[:, None])
    first = task.record.torque_nm[: model.max_lag, None]
    return lambda: np.asarray(model.predict(X=inputs, y=first)).ravel()


CONTENDERS = (
    Contender("oracle", "scipy, the 5 true parameters", oracle),
    Contender("ours, maximum-likelihood", "identify, the default", ours),
    Contender("ours, two-stage", "identify, the paper's method", ours_two_stage),
    Contender("SIPPY", "sippy_unipi, N4SID on the PRBS + spline", sippy),
    Contender("jax-sysid", "two states, spline inputs, L-BFGS", jax_sysid),
    Contender("SysIdentPy", "FROLS on spline inputs, extended LS", sysidentpy),
)
