"""The draws of a short record's fit as one solved problem, for tests, bands and MODEL.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.earlier import Change, Earlier
from stimrig.identify.estimation.short_record import Short, fit_short
from stimrig.identify.estimation.solve import Fitted, gram
from stimrig.identify.estimation.still import joint_of
from stimrig.identify.model import Model
from stimrig.identify.noise import profile
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import Setup
from stimrig.identify.recruitment.near_shape import DEVIATIONS

LEAST_SD = 1e-5
"""Standard deviation, as a share of the plateau, that is added to the curve's coefficients: below its threshold a curve
is known so exactly that the covariance could not be inverted."""
RIDGE = 1e-10
"""Share of each variance that is added, for the same reason."""
DRAWS = 1500
NEAR_SIGMOID_OPTIONS = {"recruitment", "earlier", "order"}


@dataclass(frozen=True, eq=False)
class Averaged(Fitted):
    """A solved problem whose parameters are the mean of draws."""

    effective_parameters: float = 0.0  # effective number of parameters that the data determine

    @property
    def freedom(self) -> float:
        """Effective number of parameters."""
        return self.effective_parameters


def averaged(short: Short, mean_of_draws: bool = True) -> Averaged:
    """The solved problem of a fit by draws, in the parameters of `problem.problem`.

    These are the mean of the draws; without `mean_of_draws` the most probable ones.
    """
    setup = _setup(short)
    draws = _parameters(short, setup)
    theta = draws.mean(axis=0) if mean_of_draws else _most_probable(short, setup)
    first = Problem(setup, [])
    mean, slopes = first.run(np.clip(theta, first.lower, first.upper), derivatives=True)
    assert slopes is not None
    white = setup.whitened(slopes, short.noise)
    information = gram(white)
    at = first.coefficients
    covariance = np.cov(draws.T)
    covariance[at, at] += (LEAST_SD * short.plateau_nm) ** 2 * np.eye(short.basis.size)
    hessian = _inverse(covariance)
    # The draws' centre is where data and prior balance: nothing pulls the curve away from it.
    centred = setup.with_(roughness=positive((hessian - information)[at, at]), curve_nm=theta[at])
    problem = Problem(centred, [])
    residual = setup.target_nm - mean
    effective_parameters = float(np.trace(np.linalg.solve(hessian + 1e-12 * np.diag(np.diag(hessian)), information)))
    return Averaged(
        problem=problem,
        theta=np.clip(theta, first.lower, first.upper),
        noise=short.noise,
        log_likelihood=profile(residual, setup.stretches, short.noise, False)[1],
        log_evidence=float(np.logaddexp.reduce([mode.log_evidence for mode in short.modes])),
        residual_nm=residual,
        slopes=slopes,
        hessian=hessian,
        effective_parameters=min(effective_parameters, float(theta.size)),
    )


def _setup(short: Short) -> Setup:
    grid = short.grid
    zero = short.sign * float(short.others_nm[:, 0].mean())
    target = short.sign * (grid.torque_nm - zero)
    return Setup(
        grid=grid,
        target_nm=target,
        fitted=short.rows,
        basis=short.basis,
        scale_nm=max(float(np.percentile(np.abs(target[short.rows]), 99.5)), 1e-9),
        noise_sd_nm=grid.noise_sd_nm,
        delay_bounds_s=grid.delay_bounds_s,
        zero_nm=zero,
        sign=short.sign,
        **joint_of(grid, short.rows),
    )


def _parameters(short: Short, setup: Setup) -> np.ndarray:
    """Draws in the order and on the scale of the problem's parameters, shape (S, P)."""
    others = short.others_nm.copy()
    others[:, : setup.grid.begins.size] -= setup.sign * setup.zero_nm
    return np.c_[np.log(short.dynamics[:, :2]), short.dynamics[:, 2], others, short.coefficients_nm]


def _most_probable(short: Short, setup: Setup) -> np.ndarray:
    others = short.most_probable[short.basis.size :].copy()
    others[: setup.grid.begins.size] -= setup.sign * setup.zero_nm
    t, z = short.linear.core
    return np.r_[np.log(t), np.log(z), short.linear.delay_s, others, np.cumsum(short.most_probable[: short.basis.size])]


def _inverse(covariance: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-18))
    scaled = covariance / size[:, None] / size[None, :] + RIDGE * np.eye(size.size)
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors / np.maximum(values, RIDGE)) @ vectors.T
    return inverse / size[:, None] / size[None, :]


def positive(matrix: np.ndarray) -> np.ndarray:
    """The nearest matrix that is symmetric and has no negative eigenvalue."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def near_sigmoid(grid: Grid, rows: np.ndarray, options: Mapping[str, Any]) -> tuple[Fitted, list[str]]:
    """A curve that never falls, near a sigmoid or near the person's last curve, and why it is as it is.

    Raises BadRequest: options that belong to another kind of curve, or an earlier model that is none.
    """
    others = sorted(set(options) - NEAR_SIGMOID_OPTIONS)
    if others or options.get("recruitment", "near-sigmoid") != "near-sigmoid":
        against = ", ".join(others) or f"recruitment={options['recruitment']}"
        raise BadRequest(f"not with {against}", place="recruitment", fix="Give near-sigmoid, and earlier or nothing.")
    model = options.get("earlier")
    if model is not None and not isinstance(model, Model):
        raise BadRequest("not a model", place="earlier", fix="Give the person's last model, or none.")
    last = None if model is None else Earlier(model, Change())
    short = fit_short(grid, rows, last=last, fine=True, draws=DRAWS)
    return averaged(short), [_why(short, last)]


def _why(short: Short, last: Earlier | None) -> str:
    if last is not None:
        return "a curve that never falls, near that of the last model"
    kind = DEVIATIONS[int(np.argmax(short.weights))]
    return f"a curve that never falls; its slope is a sigmoid's times a factor of {np.exp(kind.sd):.1f} or less, mostly"
