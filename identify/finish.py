"""From a solution to a model: noise, ceiling, figures, covariance, validity."""

from __future__ import annotations

from datetime import UTC, datetime
from uuid import uuid4

import numpy as np

from identify.figures import figures, white_sd
from identify.model import Covariance, Model, Noise
from identify.projection import Solution
from identify.recruitment.curve import Curve
from identify.simulate import fingerprint, predict_on


def finish(method_id: str, solution: Solution, delta_bic: float) -> Model:
    """The model of a solution, with everything that MODEL.json tells."""
    problem, grid = solution.problem, solution.problem.grid
    size = problem.basis.size
    coefficients = solution.coefficients
    initial = (0.0, 0.0) if problem.from_rest else (float(coefficients[size + 1]), float(coefficients[size + 2]))
    block_sd = float(np.sqrt(solution.variance / (1.0 - solution.ar1**2)))
    model = Model(
        method=method_id,
        recruitment=Curve(problem.basis, coefficients[:size]),
        linear=solution.linear,
        pulse_rate_hz=1.0 / grid.step_s,
        sample_rate_hz=grid.record.sample_rate_hz,
        baseline_nm=float(coefficients[size]),
        initial=initial,
        covariance=covariance(solution),
        model_id=str(uuid4()),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        data={
            "name": grid.record.source.name,
            "recording_id": grid.record.source.recording_id,
            "sha256": grid.record.source.sha256,
            "fingerprint": fingerprint(grid.record),
        },
    )
    predicted = predict_on(model, grid)
    sd = white_sd(grid, predicted, block_sd, solution.freedom, solution.ar1 == 0.0)
    noise = Noise(white_sd_nm=sd, block_sd_nm=block_sd, ar1=solution.ar1, delta_bic=delta_bic)
    return model.with_(noise=noise, fit=figures(grid, problem.rows, predicted, sd))


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
