"""Maximum likelihood: one joint estimate of recruitment and dynamics on all segments, with white or correlated noise.

It differs from the paper: the cost (12), the output error, is minimised over recruitment and dynamics together, instead
of one after the other; the noise may be correlated; the smoothness of the spline is chosen from the data. Other curves:
power series (6), sigmoid (30), a monotone spline, near-sigmoid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import LONGEST_DELAY_S, Grid
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.candidates import words
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.plain import fit_plain, fit_spline, start_at
from stimrig.identify.estimation.samples import fitted_rows
from stimrig.identify.estimation.solve import Fitted, solve
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import flag, order_option
from stimrig.identify.methods.transfer_function import general
from stimrig.identify.model import Model
from stimrig.identify.noise import WHITE_AND_SLOW
from stimrig.identify.recruitment import Basis
from stimrig.identify.recruitment.bases import PowerBasis, SigmoidBasis
from stimrig.identify.recruitment.smoothing import KNOTS

HIGHEST_POWER = 9
LEAST_KNOTS, MAX_KNOTS = 4, 201


def with_basis(first: Fitted, basis: Basis) -> Fitted:
    """Joint estimate with a curve of another basis and white noise, from the dynamics of a first one."""
    none = np.zeros((basis.size, basis.size))
    problem, theta, white = start_at(first.problem.setup.without_penalty(basis), first.linear, none)
    return solve(problem, theta, white, tolerance=1e-6)


def power_series(first: Fitted, order: int | None = None) -> tuple[Fitted, str]:
    """Joint estimate with the power series (6), of given order or of smallest BIC, and the reason."""
    setup = first.problem.setup
    fits = {
        power: with_basis(first, PowerBasis(power, setup.basis.largest_us))
        for power in ([order] if order else range(1, HIGHEST_POWER + 1))
    }
    price = np.log(setup.fitted.sum())
    best = min(fits, key=lambda power: -2 * fits[power].log_likelihood + power * price)
    return fits[best], f"power series of order {best}" + ("" if order else ", by BIC")


def sigmoid(first: Fitted) -> Fitted:
    """Joint estimate with the sigmoid (30): its steepness and middle are searched, all else is estimated at each."""
    from scipy.optimize import least_squares

    largest, rows = first.problem.setup.basis.largest_us, first.problem.setup.fitted
    u = np.linspace(0.0, largest, 401)
    level = first.curve(u) / max(float(first.curve(u).max()), 1e-300)
    middle, rise = (float(np.interp(share, np.maximum.accumulate(level), u)) for share in (0.5, 0.8))
    steep = float(np.log(1.4 / max(rise - middle, largest / 400)))
    lower, upper = [np.log(0.5 / largest), 0.0], [np.log(2000.0 / largest), 1.2]

    def at(x: np.ndarray) -> Fitted:
        return with_basis(first, SigmoidBasis.at(x[0], x[1] * largest, largest))

    start = np.clip([steep, middle / largest], np.array(lower) + 1e-9, np.array(upper) - 1e-9)
    optimum = least_squares(
        lambda x: at(x).residual_nm[rows], start, bounds=(lower, upper), x_scale=[0.1, 0.02], diff_step=1e-4
    )
    return at(optimum.x)


def monotone(fitted: Fitted) -> Fitted:
    """The fit with a recruitment curve that never falls (or never rises, if stimulation lowers the torque).

    A B-spline curve rises if its coefficients rise. The coefficients are sums of steps of one sign, found by
    non-negative least squares for the same penalised problem and the same dynamics.
    """
    from scipy.optimize import nnls

    problem, first, size = fitted.problem, fitted.problem.baselines.start, fitted.problem.setup.basis.size
    linear = slice(first, problem.coefficients.stop)
    root = np.linalg.cholesky(fitted.hessian[linear, linear]).T
    extras = len(root) - size
    steps = np.zeros((len(root), 2 * extras + size))
    steps[extras:, 2 * extras :] = np.tril(np.ones((size, size)))
    steps[:extras, : 2 * extras] = np.kron(np.eye(extras), [1.0, -1.0])  # these may have either sign
    theta = fitted.theta.copy()
    theta[linear] = steps @ nnls(root @ steps, root @ theta[linear], maxiter=50 * steps.shape[1])[0]
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    return replace(fitted, theta=theta, residual_nm=problem.setup.target_nm - mean, slopes=slopes)


def fit(grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
    """Fit; see `identify.fit`."""
    rows = fitted_rows(grid, fit_on)
    order = order_option(options.get("order", "second-order"))
    if order != "second-order":
        return general(METHOD.id, grid, rows, rows, 8, int(options.get("knots", KNOTS)), order)
    fitted, reasons = start(grid, rows, options)
    return finish(METHOD.id, fitted, [*reasons, *_why(fitted)])


def start(grid: Grid, rows: np.ndarray, options: Mapping[str, Any]) -> tuple[Fitted, list[str]]:
    """Fit the structure without effects, to which effects are added; with the reasons for its form."""
    if options.get("recruitment") == "near-sigmoid" or "earlier" in options:
        from stimrig.identify.estimation.averaged import near_sigmoid  # here: only this curve needs scipy

        return near_sigmoid(grid, rows, options)
    delay_s = float(options["delay_s"]) if "delay_s" in options else None
    knots, power = (int(options[name]) if name in options else None for name in ("knots", "power"))
    for name, value, lowest, highest in (
        ("delay_s", delay_s, 0.0, LONGEST_DELAY_S),
        ("knots", knots, LEAST_KNOTS, MAX_KNOTS),
        ("power", power, 1, HIGHEST_POWER),
    ):
        if value is not None and not lowest <= value <= highest:
            raise BadRequest(f"{value:g} is out of range", place=name, fix=f"Give {lowest:g} to {highest:g}.")
    kind = str(options.get("recruitment", "spline"))
    if kind not in {"spline", "power-series", "sigmoid"}:
        fix = "Give spline, power-series, sigmoid or near-sigmoid."
        raise BadRequest(f"unknown recruitment {kind!r}", place="recruitment", fix=fix)
    rising = flag(options.get("monotone", False), "monotone")
    if rising and kind != "spline":
        raise BadRequest(f"only a spline is made monotone, not {kind}", place="monotone", fix="Leave one of them out.")
    if kind == "spline" and not rising:
        best = fit_plain(grid, rows, knots, delay_s)
        return best, [_spline_words(best), *words(best, rows)]
    fitted = fit_spline(grid, rows, knots, delay_s)
    reason = _spline_words(fitted)
    if kind == "power-series":
        fitted, reason = power_series(fitted, power)
    elif kind == "sigmoid":
        fitted, reason = sigmoid(fitted), "sigmoid (30)"
    if rising:
        return monotone(fitted), [reason, "recruitment constrained to be monotone"]
    return solve(fitted.problem, fitted.theta, WHITE_AND_SLOW, max_steps=0), [reason]


def _spline_words(fitted: Fitted) -> str:
    at, prior = fitted.problem.coefficients, fitted.problem.prior[1]
    size = at.stop - at.start
    free = size - float(np.trace(np.linalg.solve(fitted.hessian, prior)[at, at]))
    return f"spline of {size} coefficients, smoothed to {free:.1f} effective ones"


METHOD = Method(
    "maximum-likelihood",
    "Joint estimate of recruitment spline and second-order dynamics by variable projection on all segments.",
    {
        "recruitment": "spline (default, (8)), power-series (6), sigmoid (30) or near-sigmoid, for short records",
        "earlier": "with near-sigmoid: this person's last model, from which the curve is not expected to be far",
        "monotone": "true: the spline never falls (default: false)",
        "knots": "number of knots of the spline (default: 19, or 31 if the curve is steep)",
        "power": "order of the power series (default: by BIC)",
        "delay_s": "a known delay, s (default: estimated)",
        "order": "second-order (default), auto, or l,n,d of equations (1) to (3)",
    },
    fit,
)


def _why(fitted: Fitted) -> list[str]:
    time_constant_s, damping, delay_s = fitted.physical[:3]
    noise = fitted.noise
    slow = 100 * min(noise.share, 1.0)
    mixed = f"slow and white; {slow:.0f} % of the variance of the residual's means over pulse intervals is slow"
    kind = "white" if noise.is_white else mixed
    enough = "a white residual" if noise.is_white else "what is left is not white: slow noise, or see the diagnosis"
    return [
        f"second order: T {time_constant_s:.4g} s, damping {damping:.3g}, delay {1e3 * delay_s:.1f} ms; {enough}",
        f"noise: {kind}",
    ]
