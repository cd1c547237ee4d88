"""From a solution to a model: noise, ceiling, figures, covariance, validity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

import numpy as np

from identify.dynamics.linear import Discrete
from identify.dynamics.narx import run
from identify.dynamics.pulse_grid import Grid, runs
from identify.estimation.cross_validation import held_out_change
from identify.estimation.figures import figures, white_sd
from identify.estimation.projected import Solution
from identify.estimation.quality import quality, valid_for
from identify.estimation.residual_tests import residual_tests
from identify.estimation.uncertainty import bands
from identify.model import Covariance, Model, Noise
from identify.noise.ar1 import noise_evidence
from identify.recruitment.curve import Curve
from identify.simulation.predict import fingerprint, predict_on


def finish(method_id: str, solution: Solution, delta_bic: float, reasons: Sequence[str] = ()) -> Model:
    """The model of a solution, with everything that MODEL.json tells."""
    problem, grid = solution.problem, solution.problem.grid
    size = problem.basis.size
    coefficients = solution.coefficients
    block_sd = float(np.sqrt(solution.variance / (1.0 - solution.ar1**2)))
    model = Model(
        method=method_id,
        recruitment=Curve(problem.basis, coefficients[:size]),
        linear=solution.linear,
        pulse_rate_hz=1.0 / grid.step_s,
        sample_rate_hz=grid.record.sample_rate_hz,
        baseline_nm=float(coefficients[size]),
        initial=(0.0, 0.0) if problem.from_rest else (float(coefficients[size + 1]), float(coefficients[size + 2])),
        covariance=covariance(solution),
        noise=Noise(block_sd_nm=block_sd, ar1=solution.ar1, delta_bic=delta_bic),
        reasons=tuple(reasons),
    )
    model = completed(model, grid, problem.rows, solution.freedom, solution)
    return model.with_(bands=bands(model))


def finish_discrete(
    method_id: str,
    grid: Grid,
    rows: np.ndarray,
    block: Discrete,
    curve: Curve,
    reasons: Sequence[str] = (),
    extra: dict[str, Any] | None = None,
) -> Model:
    """The model of a method that gives a discrete block and a curve, without covariance."""
    if extra and "narx" in extra:
        response = run(extra["narx"], grid.held(grid.pulse_width_us))
    else:
        response = block.filter(grid.held(curve(grid.pulse_width_us)))
    residual = np.nan_to_num(grid.torque_nm) - np.nan_to_num(response, nan=1e6, posinf=1e6, neginf=-1e6)
    baseline = float(np.mean(residual[rows]))
    free = curve.basis.size + len(block.a) + len(block.b)
    ar1, delta_bic = noise_evidence(residual - baseline, runs(rows))
    spread = float(np.sum((residual - baseline)[rows] ** 2)) / max(int(rows.sum()) - free, 1)
    model = Model(
        method=method_id,
        recruitment=curve,
        linear=block,
        pulse_rate_hz=1.0 / grid.step_s,
        sample_rate_hz=grid.record.sample_rate_hz,
        baseline_nm=baseline,
        noise=Noise(block_sd_nm=float(np.sqrt(spread)), ar1=ar1, delta_bic=delta_bic),
        reasons=tuple(reasons),
        extra=extra or {},
    )
    return completed(model, grid, rows, free)


def completed(model: Model, grid: Grid, rows: np.ndarray, freedom: float, solution: Solution | None = None) -> Model:
    """The model with its figures, its tests, its validity, its name and its origin."""
    source = grid.record.source
    model = model.with_(
        model_id=str(uuid4()),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        data={
            "name": source.name,
            "recording_id": source.recording_id,
            "sha256": source.sha256,
            "fingerprint": fingerprint(grid.record),
        },
    )
    predicted = predict_on(model, grid)
    sd = white_sd(grid, predicted, model.noise.block_sd_nm, freedom, model.noise.ar1 == 0.0)
    change = None if solution is None or grid.record.has_held_out else held_out_change(solution)
    model = model.with_(
        noise=replace(model.noise, white_sd_nm=sd),
        fit=figures(grid, rows, predicted, sd, change),
        residual_tests={} if solution is None else residual_tests(solution),
        valid_for=valid_for(model, grid, rows),
    )
    return model.with_(quality=quality(model, grid, rows, solution is None or solution.converged))


def covariance(solution: Solution) -> Covariance:
    """Covariance of all parameters: noise variance times the inverse of the penalised information.

    The penalty stands for a prior, so this is the posterior's covariance; bands from it cover the truth as often as
    they say, averaged over the curve (Nychka 1988).
    """
    problem = solution.problem
    scale = 1.0 / np.sqrt(np.maximum(np.diag(solution.gram), 1e-300))
    scaled = solution.gram * scale[:, None] * scale[None, :]
    inverse = np.linalg.inv(scaled + 1e-12 * np.eye(len(scale))) * scale[:, None] * scale[None, :]
    size, extras = problem.basis.size, problem.extras
    lead = len(scale) - size - extras
    # From (log T, log ζ) to (T, ζ).
    turn = np.ones(len(scale))
    turn[size + extras] = solution.linear.time_constant_s
    turn[size + extras + 1] = solution.linear.damping
    matrix = solution.variance * inverse * turn[:, None] * turn[None, :]
    order = np.r_[size + extras : len(scale), size : size + extras, 0:size]
    names = ("time_constant_s", "damping", "delay_s")[:lead]
    names += ("baseline_nm", "initial_torque_nm", "initial_rate_nm_s")[:extras]
    names += tuple(f"recruitment_{i}_nm" for i in range(size))
    dynamics = [solution.linear.time_constant_s, solution.linear.damping, solution.linear.delay_s][:lead]
    values = np.r_[dynamics, solution.coefficients[size:], solution.coefficients[:size]]
    return Covariance(names, values, matrix[np.ix_(order, order)])
