"""From a fit to a model: fit statistics, residual tests, covariance, bands, range of validity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of, runs
from stimrig.identify.dynamics.linear import Discrete, SecondOrder, run_narx
from stimrig.identify.estimation.contradiction import contradiction
from stimrig.identify.estimation.fit_statistics import evaluate, fit_statistics, white_sd
from stimrig.identify.estimation.joint_sensor import sensor_of, words
from stimrig.identify.estimation.quality import quality, valid_for
from stimrig.identify.estimation.residual_tests import residual_tests
from stimrig.identify.estimation.shapes import shape_of
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.estimation.uncertainty import bands, covariance_of, unexplained
from stimrig.identify.model import Covariance, Model, Noise
from stimrig.identify.noise import correlation
from stimrig.identify.problem.joint_surface import Surfaces, joint_tables
from stimrig.identify.problem.predict import fingerprint, predict_on
from stimrig.identify.problem.setup import SETTINGS
from stimrig.identify.recruitment import Curve

AT_WORK = 0.05


def finish(
    method_id: str, fitted: Fitted, reasons: Sequence[str] = (), statistics: dict[str, Any] | None = None
) -> Model:
    """The model of a fit, with all that MODEL.json contains.

    `reasons`: why the structure is as it is. `statistics`: the fit statistics, if they are known already.
    """
    statistics = statistics or evaluate(fitted)
    tests = residual_tests(fitted)
    known = fitted.problem.size
    written = fitted.written
    problem, values, setup = written.problem, written.physical, written.problem.setup
    matrix = covariance_of(written)
    parts_differ = contradiction(written)
    statistics = statistics | {"unexplained_nm": unexplained(written, matrix, parts_differ)}
    if parts_differ is not None:
        statistics["contradiction"] = parts_differ
    covariance = _covariance(written, matrix, known)
    torque, rate = setup.sign * values[list(problem.initials)[:2]]
    model = Model(
        method=method_id,
        recruitment=Curve(setup.basis, setup.sign * values[problem.coefficients]),
        linear=SecondOrder(*(float(value) for value in values[:3])),
        pulse_rate_hz=1.0 / setup.grid.step_s,
        sample_rate_hz=setup.grid.record.sample_rate_hz,
        baseline_nm=float(setup.to_record(values[problem.baselines.start])),
        initial=(float(torque), float(rate)),
        covariance=covariance,
        noise=Noise(
            white_sd_nm=statistics["noise_sd_nm"], block_sd_nm=fitted.noise.sd_nm, ar1=fitted.noise.correlation
        ),
        effects=tuple(_effect(written, index, matrix) for index in range(len(problem.chosen))),
        fit=statistics,
        residual_tests=tests,
        reasons=tuple(reasons),
        extra=_parts(written),
    )
    model, sensor = _named(model, setup.grid), sensor_of(fitted)
    if sensor:
        model = model.with_(data=model.data | {"joint_sensor": sensor}, reasons=(*model.reasons, *words(sensor)))
    model = model.with_(joint=_joint(model, written, matrix[:known, :known]))
    model = model.with_(bands=bands(model), valid_for=valid_for(model, setup.grid, setup.fitted))
    return model.with_(quality=quality(model, setup.grid, setup.fitted, fitted.converged))


def _joint(model: Model, fitted: Fitted, matrix: np.ndarray) -> dict[str, Any]:
    """g and h over the angles and velocities of the fitted rows; empty without an angle, or where nothing asks for one.

    Rows with less than `AT_WORK` of the largest torque show the passive part alone.
    """
    grid, rows = fitted.problem.setup.grid, fitted.problem.setup.fitted
    if grid.angle_rad is None or grid.velocity_rad_s is None or Surfaces.of(model.effects) is None:
        return {}
    assert model.covariance is not None
    level = np.abs(model.recruitment(grid.pulse_width_us[rows]))
    at_work = level > AT_WORK * float(level.max())
    motion = grid.angle_rad[rows], grid.velocity_rad_s[rows]
    return joint_tables(model.effects, model.covariance.names, matrix, *motion, at_work)


def _parts(fitted: Fitted) -> dict[str, Any]:
    """Baseline, torque, N·m, and rate, N·m/s, of every initial state, if the record has more than one."""
    problem, setup, values = fitted.problem, fitted.problem.setup, fitted.physical
    if setup.grid.starts.size == 1:
        return {}
    states = setup.sign * values[list(problem.initials)].reshape(-1, 2)
    baselines = setup.to_record(values[list(problem.baselines)])[setup.grid.part[setup.grid.starts]]
    return {"parts": np.c_[baselines, states].tolist()}


def _named(model: Model, grid: Grid) -> Model:
    source = grid.record.source
    return model.with_(
        model_id=str(uuid4()),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        data={
            "name": source.name,
            "recording_id": source.recording_id,
            "sha256": source.sha256,
            "fingerprint": fingerprint(grid.record),
        },
    )


def _covariance(fitted: Fitted, matrix: np.ndarray, known: int) -> Covariance:
    """Covariance of all estimated parameters, with the record's sign of torque."""
    problem = fitted.problem
    sign = np.ones(known)
    sign[3 : problem.coefficients.stop] = problem.setup.sign
    values = fitted.physical[:known] * sign
    first = problem.baselines.start
    values[first : problem.baselines.stop] += problem.setup.zero_nm
    matrix = matrix[:known, :known] * sign[:, None] * sign[None, :]
    return Covariance(problem.names[:known], values, matrix)


def _effect(fitted: Fitted, index: int, matrix: np.ndarray) -> dict[str, Any]:
    chosen = fitted.problem.chosen[index]
    setup = fitted.problem.setup
    unpredictable = fitted.unpredictable_torque.get(chosen.effect)
    shape = shape_of(fitted, index, matrix)
    settings = {name: getattr(setup, name) for name in SETTINGS} | {"angle_late_s": setup.angle_late_s or None}
    entry = {
        "id": chosen.effect,
        "form": chosen.form.name,
        "stage": chosen.form.stage,
        "equation": chosen.form.equation,
        "parameters": describe_parameters(fitted, index, matrix),
        "settings": {name: value for name, value in settings.items() if value is not None},
    }
    if unpredictable is not None:
        entry["unforeseen"] = {"mean_nm": unpredictable[0], "rms_nm": unpredictable[1]}
    if shape is not None:
        entry["shape"] = shape
    return entry


def describe_parameters(fitted: Fitted, index: int, matrix: np.ndarray) -> dict[str, dict[str, Any]]:
    """Value, sd and unit of an effect's parameters by name; with `direction` if the record has the opposite sign.

    What was estimated from the samples, before the fit, has no sd: the fit's would be that of the prior.
    Torques of an effect are positive in the direction in which the muscle pulls, except those of the sensor, which have
    the sign of the record.
    """
    chosen = fitted.problem.chosen[index]
    values = fitted.physical
    turned = fitted.problem.setup.sign < 0 and chosen.form.stage != "sensor"
    return {
        p.name: {
            "value": float(values[i]),
            "sd": None if chosen.form.fixed else float(np.sqrt(max(matrix[i, i], 0.0))),
            "unit": p.unit,
        }
        | ({"direction": "as the muscle pulls"} if turned and p.unit.startswith("N·m") else {})
        for i, p in zip(chosen.places, chosen.parameters, strict=True)
    }


def finish_discrete(
    method_id: str,
    grid: Grid,
    rows: np.ndarray,
    block: Discrete,
    curve: Curve,
    reasons: Sequence[str] = (),
    extra: dict[str, Any] | None = None,
) -> Model:
    """The model of a method that gives a discrete block and a curve, but no covariance."""
    if extra and "narx" in extra:
        response = run_narx(extra["narx"], grid.interval_means(grid.pulse_width_us))
    else:
        response = block.filter(grid.interval_means(curve(grid.pulse_width_us)))
    residual = np.nan_to_num(grid.torque_nm) - np.nan_to_num(response, nan=1e6, posinf=1e6, neginf=-1e6)
    baseline = float(np.mean(residual[rows]))
    free = curve.basis.size + len(block.a) + len(block.b)
    spread = float(np.sum((residual - baseline)[rows] ** 2)) / max(int(rows.sum()) - free, 1)
    ar1 = correlation(residual - baseline, ends_of(runs(rows)), grid.step_s)
    model = Model(
        method=method_id,
        recruitment=curve,
        linear=block,
        pulse_rate_hz=1.0 / grid.step_s,
        sample_rate_hz=grid.record.sample_rate_hz,
        baseline_nm=baseline,
        noise=Noise(block_sd_nm=float(np.sqrt(spread)), ar1=ar1),
        reasons=tuple(reasons),
        extra=extra or {},
    )
    return completed(model, grid, rows, free)


def completed(model: Model, grid: Grid, rows: np.ndarray, freedom: float) -> Model:
    """Complete a model without covariance: fit statistics, id, range of validity and quality."""
    model = _named(model, grid)
    predicted = predict_on(model, grid)
    noise = white_sd(grid, predicted, model.noise.block_sd_nm, freedom, model.noise.ar1 == 0.0)
    model = model.with_(
        noise=replace(model.noise, white_sd_nm=noise),
        fit=fit_statistics(grid, rows, predicted, noise),
        valid_for=valid_for(model, grid, rows),
    )
    return model.with_(quality=quality(model, grid, rows))
