"""Contenders: ours, peers from PyPI, black boxes, the oracle. Each fits the same rows and predicts in free run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from bench.black_boxes import gaussian_process, hammerstein_wiener
from bench.tasks import Task
from stimrig import identify
from tests.harness.muscle import second_order, sigmoid

SPLINES = 8


class Passes(Exception):
    """A task that is not for this contender, and why."""


@dataclass(frozen=True)
class Contender:
    """A name, where it is from, how it fits: a task in, free-run torque for all samples out."""

    name: str
    what: str
    fit: Callable[[Task], Callable[[], np.ndarray]]
    fine: bool = False
    """It takes more than one sample a pulse."""


def spline_inputs(task: Task) -> np.ndarray:
    """Cubic B-splines of the pulse width, zero at zero, shape (N, SPLINES): recruitment for linear packages."""
    top = max(300.0, float(task.record.pulse_width_us.max()))
    knots = np.r_[[0.0] * 3, np.linspace(0.0, top, SPLINES - 1), [top] * 3]
    return BSpline(knots, np.eye(SPLINES + 1), 3)(task.record.pulse_width_us)[:, 1:]


def ours(task: Task, method: str = "maximum-likelihood") -> Callable[[], np.ndarray]:
    model = identify.fit(task.record, method=method)
    return lambda: identify.predict(model, task.record)


def ours_improved(task: Task) -> Callable[[], np.ndarray]:
    model = identify.improve(task.record).models[-1]
    return lambda: identify.predict(model, task.record)


def oracle(task: Task) -> Callable[[], np.ndarray]:
    """scipy's least squares on the five true parameters, from a start that is 20 % off."""
    if not task.true:
        raise Passes("its truth is not known")
    width, rate, fitted = task.record.pulse_width_us, task.rate_hz, task.fitted

    def simulate(x: np.ndarray) -> np.ndarray:
        gain, steep, middle, period, damping = x
        drive = sigmoid(width, gain, steep, np.exp(min(steep * middle, 600.0)))
        return second_order(drive, period, damping, rate)

    measured = task.record.torque_nm[fitted]
    start = np.array([6.9 * 1.2, 0.041 * 0.8, 190.0 * 1.1, 0.5284 * 0.8, 0.6369 * 1.2])
    solution = least_squares(lambda x: simulate(x)[fitted] - measured, start, x_scale=np.abs(start), xtol=1e-10)
    return lambda: simulate(solution.x)


def sippy(task: Task) -> Callable[[], np.ndarray]:
    """N4SID of order 2 on the PRBS, then the spline by least squares through what it found.

    With the splines as inputs of one N4SID it runs away: two levels of a PRBS don't excite ten inputs.
    """
    from sippy_unipi import system_identification

    names = np.array(task.record.segment_names)[task.record.segment]
    rows = slice(0, int(np.flatnonzero(names == "prbs")[-1]) + 1)
    level = task.record.pulse_width_us[rows] / np.max(task.record.pulse_width_us)
    measured = task.record.torque_nm
    system = system_identification(measured[rows][None], level[None], "N4SID", SS_fixed_order=2, SS_A_stability=True)

    def respond(columns: np.ndarray) -> np.ndarray:
        state, response = np.zeros((2, columns.shape[1])), np.empty_like(columns)
        for k, u in enumerate(columns):
            response[k] = (system.C @ state + system.D * u)[0]
            state = system.A @ state + system.B * u
        return response

    columns = respond(spline_inputs(task))
    weights = np.linalg.lstsq(columns[task.fitted], measured[task.fitted], rcond=None)[0]
    return lambda: columns @ weights


def jax_sysid(task: Task) -> Callable[[], np.ndarray]:
    """Two states, spline inputs, L-BFGS."""
    import jax
    from jax_sysid.models import LinearModel

    jax.config.update("jax_enable_x64", True)
    inputs = spline_inputs(task)
    scale = float(np.std(task.record.torque_nm[task.fitted]))
    measured = task.record.torque_nm[:, None] / scale
    model = LinearModel(2, 1, SPLINES, feedthrough=False)
    model.loss(rho_x0=1e-3, rho_th=1e-9)
    model.optimization(adam_epochs=0, lbfgs_epochs=3000, iprint=-1)
    model.fit(measured[task.longest], inputs[task.longest])
    return lambda: np.asarray(model.predict(np.zeros((2, 1)), inputs)[0]).ravel() * scale


def sysidentpy(task: Task) -> Callable[[], np.ndarray]:
    """FROLS on spline inputs with extended least squares, scored in free run from the first samples."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    inputs, rows, measured = spline_inputs(task), task.longest, task.record.torque_nm[:, None]
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
    model.fit(X=inputs[rows], y=measured[rows])
    return lambda: np.asarray(model.predict(X=inputs, y=measured[: model.max_lag])).ravel()


CONTENDERS = (
    Contender("oracle", "scipy, the 5 true parameters", oracle, fine=True),
    Contender("ours, plain", "identify, the default", ours, fine=True),
    Contender("ours, improve", "effects of the library", ours_improved),
    Contender("ours, two-stage", "identify, the paper's method", partial(ours, method="two-stage"), fine=True),
    Contender("ours, narx", "identify's polynomial NARX by FROLS", partial(ours, method="narx")),
    Contender("SIPPY", "sippy_unipi, N4SID on the PRBS + spline", sippy, fine=True),
    Contender("jax-sysid", "two states, spline inputs, L-BFGS", jax_sysid, fine=True),
    Contender("SysIdentPy", "FROLS on spline inputs, extended LS", sysidentpy, fine=True),
    Contender("Hammerstein-Wiener", "as nlhw: piecewise linear, order 2 or 3", hammerstein_wiener),
    Contender("Gaussian process", "lagged inputs, 2 s of memory, Nyström", gaussian_process),
)
