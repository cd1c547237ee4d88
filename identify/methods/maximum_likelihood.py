"""Maximum likelihood: one joint estimate of recruitment and dynamics on all segments, with white or correlated noise.

It differs from the paper: the cost (12), the output error, is minimised over recruitment and dynamics together, instead
of one after the other; the noise may be correlated; the smoothness of the spline is chosen from the data. Other curves:
power series (6), sigmoid (30), a monotone spline, near-sigmoid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S, SecondOrder
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.candidates import chosen, words
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.plain import estimate, still_rows, to_fitted
from stimrig.identify.estimation.projection import Projection, Solution, log_likelihood, search, whiten
from stimrig.identify.estimation.samples import fitted_rows
from stimrig.identify.methods import Method
from stimrig.identify.methods.common import flag, order_option
from stimrig.identify.methods.two_stage import general
from stimrig.identify.model import Model
from stimrig.identify.recruitment import basis_at
from stimrig.identify.recruitment.bases import PowerBasis, SigmoidBasis
from stimrig.identify.recruitment.smoothing import KNOTS

HIGHEST_POWER = 9


def power_series(first: Solution, order: int | None = None) -> tuple[Solution, str]:
    """Joint estimate with the power series (6), of given order or of smallest BIC, and the reason."""
    old = first.projection
    largest = float(np.max(old.grid.pulse_width_us))
    fits: dict[int, tuple[float, Solution]] = {}
    linear = first.linear
    for power in [order] if order else range(1, HIGHEST_POWER + 1):
        basis = PowerBasis(power, largest)
        problem = Projection(old.grid, basis, np.zeros((power, power)), old.rows, old.delay_s)
        solution = search(problem, linear)
        rows = sum(s.stop - s.start for s in problem.stretches)
        likelihood = log_likelihood(solution.residual_nm, problem.stretches, 0.0)
        fits[power] = (-2 * likelihood + power * np.log(rows), solution)
        linear = solution.linear
    best = min(fits, key=lambda power: fits[power][0])
    return fits[best][1], f"power series of order {best}" + ("" if order else ", by BIC")


def sigmoid(first: Solution) -> Solution:
    """Joint estimate with the sigmoid (30): shape and dynamics searched, gain and baseline projected out."""
    from scipy.optimize import least_squares

    old, start = first.projection, first.linear
    largest = float(np.max(old.grid.pulse_width_us))
    curve = old.basis.design(np.linspace(0.0, largest, 401)) @ first.coefficients[: old.basis.size]
    half = curve[np.argmax(np.abs(curve))] / 2
    middle = largest * float(np.argmin(np.abs(curve - half))) / 400
    rise = np.ptp(np.flatnonzero((curve / (2 * half) > 0.2) & (curve / (2 * half) < 0.8))) if half else 100
    steep = float(np.log(2.8 / max(largest * float(rise) / 400, largest / 400)))

    def problem(x: np.ndarray) -> Projection:
        basis: SigmoidBasis = basis_at(x[3], x[4] * largest, largest)
        return Projection(old.grid, basis, np.zeros((1, 1)), old.rows, old.delay_s)

    def linear(x: np.ndarray) -> SecondOrder:
        return SecondOrder(
            float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]) if old.delay_s is None else old.delay_s
        )

    def residual(x: np.ndarray) -> np.ndarray:
        trial = problem(x)
        solution = Solution(trial, linear(x), ar1=first.ar1)
        return whiten(solution.residual_nm, trial.stretches, first.ar1)

    bounds = np.log([TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS])
    earliest, latest = old.grid.delay_bounds_s
    lower = [*bounds[:, 0], earliest, np.log(0.5 / largest), 0.0]
    upper = [*bounds[:, 1], latest, np.log(2000.0 / largest), 1.2]
    x0 = [np.log(start.time_constant_s), np.log(start.damping), start.delay_s, steep, middle / largest]
    x0 = np.clip(x0, np.array(lower) + 1e-9, np.array(upper) - 1e-9)
    optimum = least_squares(residual, x0, bounds=(lower, upper), x_scale=[0.05, 0.05, 0.005, 0.1, 0.02], xtol=1e-10)
    return search(problem(optimum.x), linear(optimum.x), ar1=first.ar1, max_steps=3)


def monotone(solution: Solution) -> np.ndarray:
    """The coefficients with a recruitment curve that never falls (or never rises, if stimulation lowers the torque).

    A B-spline curve rises if its coefficients rise. The coefficients are sums of steps of one sign, found by
    non-negative least squares for the same penalised problem and the same dynamics.
    """
    from scipy.optimize import nnls

    problem, size = solution.projection, solution.projection.basis.size
    white = whiten(solution.columns, problem.stretches, solution.ar1)
    target = whiten(problem.target, problem.stretches, solution.ar1)
    penalty = np.zeros((white.shape[1], white.shape[1]))
    penalty[:size, :size] = solution.weight * problem.roughness
    hessian = white.T @ white + penalty
    hessian += 1e-12 * np.diag(np.diag(hessian))
    root = np.linalg.cholesky(hessian).T
    right = np.linalg.solve(root.T, white.T @ target)
    sign = 1.0 if np.sum(solution.coefficients[:size]) >= 0 else -1.0
    steps = np.zeros((white.shape[1], size + 2 * problem.extras))
    steps[:size, :size] = sign * np.tril(np.ones((size, size)))
    for extra in range(problem.extras):  # these may have either sign
        steps[size + extra, size + 2 * extra : size + 2 * extra + 2] = 1.0, -1.0
    return steps @ nnls(root @ steps, right, maxiter=50 * steps.shape[1])[0]


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
    knots = int(options["knots"]) if "knots" in options else None

    def solved(selected: np.ndarray, white: bool) -> Solution:
        return estimate(grid, still_rows(grid, selected), knots, delay_s, white)[0]

    solution = solved(rows, False)
    kind = str(options.get("recruitment", "spline"))
    if kind == "power-series":
        solution, reason = power_series(solution, int(options["power"]) if "power" in options else None)
    elif kind == "sigmoid":
        solution, reason = sigmoid(solution), "sigmoid (30)"
    elif kind == "spline":
        size = solution.projection.basis.size
        reason = f"spline of {size} coefficients, smoothed to {solution.freedom:.1f} effective ones"
    else:
        fix = "Give spline, power-series, sigmoid or near-sigmoid."
        raise BadRequest(f"unknown recruitment {kind!r}", place="recruitment", fix=fix)
    if flag(options.get("monotone", False), "monotone"):
        fitted = to_fitted(solution, rows, max_steps=0, coefficients=monotone(solution))
        return fitted, [reason, "recruitment constrained to be monotone"]
    if kind != "spline":
        return to_fitted(solution, rows, max_steps=0), [reason]
    known = to_fitted(solution, rows)
    best = chosen(grid, rows, known, lambda selected, white: to_fitted(solved(selected, white), selected, white=white))
    return best, [reason, *words(best, rows)]


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
