"""Between fits and MODEL.json: a fitted candidate as a Model, and a Model with effects run on any record."""

from __future__ import annotations

import math
import uuid
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from identify.dynamics.linear import SecondOrder
from identify.dynamics.pulse_grid import make_grid
from identify.effects import get, registry
from identify.errors import BadModel
from identify.estimation.joint import Fitted
from identify.estimation.prepare import block_means
from identify.estimation.quality import quality, valid_for
from identify.estimation.uncertainty import bands
from identify.model import Covariance, Model, Noise
from identify.noise.level import band_part
from identify.records.record import Record
from identify.recruitment.curve import Curve
from identify.recruitment.spline import SplineBasis
from identify.simulation.predict import fingerprint, same_data
from identify.simulation.problem import Problem
from identify.simulation.setup import Setup

METHOD = "maximum-likelihood"


def with_band(fitted: Fitted) -> Fitted:
    """A candidate whose noise has a narrow band, with that band written out as a tremor.

    The wave is the band's share of the residual, given all of it, as a sine whose amplitudes run straight between
    knots: a description of what was measured, nothing that could be foreseen.
    """
    effect = next((e for e in registry().values() if e.band), None)
    if fitted.noise.band <= 0.0 or effect is None:
        return fitted
    setup = fitted.problem.setup
    step_s, span_s = setup.grid.step_s, setup.scene.span_s
    wave = band_part(fitted.residual_nm, setup.stretches, fitted.noise)
    memory_s = step_s / max(1.0 - fitted.noise.keep, 1e-6)
    wanted = 1 if memory_s > 4 * span_s else 1 + span_s / max(0.35 * memory_s, 0.15)
    form = min(effect.forms, key=lambda f: abs(np.log(len(f.parameters) / (1 + 2 * wanted))))
    problem = Problem(setup, [*fitted.effects, (effect.id, form)])
    frequency_hz = fitted.noise.turn / (2 * np.pi * step_s)
    chosen = problem.chosen[-1]
    p = {q.name: np.zeros((1, 1)) for q in chosen.parameters} | {"frequency_hz": np.full((1, 1), frequency_hz)}
    columns = [
        np.asarray(form.call(None, p | {q.name: np.ones((1, 1))}, setup.scene)).ravel() for q in chosen.parameters[1:]
    ]
    design = np.stack(columns, axis=1)[setup.fitted]
    ridge = 1e-3 * np.trace(design.T @ design) / design.shape[1] * np.eye(design.shape[1])
    amplitude = np.linalg.solve(design.T @ design + ridge, design.T @ wave[setup.fitted])
    # The mean over an interval is smaller than the wave itself.
    amplitude = amplitude / np.sinc(frequency_hz * step_s)
    theta = np.r_[fitted.theta, np.log(frequency_hz), amplitude]
    hessian = np.zeros((problem.size, problem.size))
    hessian[: fitted.theta.size, : fitted.theta.size] = fitted.hessian
    rest = np.arange(fitted.theta.size, problem.size)
    hessian[rest, rest] = np.r_[1e6, np.full(rest.size - 1, 1.0 / max(fitted.noise.sd_nm, 1e-6) ** 2)]
    residual = setup.target_nm - problem.run(theta)[0]
    quiet = replace(fitted.noise, band=0.0, share=fitted.noise.share, sd_nm=float(np.std(residual[setup.fitted])))
    return replace(fitted, problem=problem, theta=theta, hessian=hessian, residual_nm=residual, noise=quiet)


def to_model(fitted: Fitted, record: Record, fit: dict[str, Any] | None = None, **changes: Any) -> Model:
    """A fitted candidate as a model.

    Parameters
    ----------
    fitted : Fitted
        The candidate.
    record : Record
        What it was fitted on.
    fit : dict
        Figures for the model's `fit`.
    """
    known = fitted.problem.size
    fitted = with_band(fitted)
    problem, values = fitted.problem, fitted.physical
    setup = problem.setup
    names = tuple(p.name for p in problem.table[: problem.coefficients.stop])
    listed = list(names)
    for chosen in problem.chosen:
        listed += [f"{chosen.effect}.{p.name}" for p in chosen.parameters]
    matrix = fitted.covariance()
    model = Model(
        method=METHOD,
        recruitment=Curve(setup.basis, values[problem.coefficients].copy()),
        linear=SecondOrder(float(values[0]), float(values[1]), float(values[2])),
        pulse_rate_hz=record.pulse_rate_hz,
        sample_rate_hz=record.sample_rate_hz,
        baseline_nm=float(values[3]),
        noise=Noise(
            white_sd_nm=setup.noise_sd_nm,
            block_sd_nm=fitted.noise.sd_nm,
            ar1=fitted.noise.ar1 if fitted.noise.share > 0.05 else 0.0,
        ),
        effects=tuple(_effect(fitted, index, matrix) for index in range(len(problem.chosen))),
        covariance=Covariance(tuple(listed[:known]), values[:known], matrix[:known, :known]),
        fit=dict(fit or {}) | {"log_evidence": fitted.log_evidence, "log_likelihood": fitted.log_likelihood},
        data={
            "fingerprint": fingerprint(record),
            "recording_id": record.source.recording_id,
            "sha256": record.source.sha256,
            "name": record.source.name,
        },
        model_id=uuid.uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    rows = setup.fitted
    model = model.with_(valid_for=valid_for(model, setup.grid, rows))
    model = model.with_(bands=bands(model), quality=quality(model, setup.grid, rows))
    return model.with_(**changes) if changes else model


def _effect(fitted: Fitted, index: int, matrix: np.ndarray) -> dict[str, Any]:
    chosen = fitted.problem.chosen[index]
    setup = fitted.problem.setup
    return {
        "id": chosen.effect,
        "form": chosen.form.name,
        "stage": chosen.form.stage,
        "equation": chosen.form.equation,
        "parameters": describe_parameters(fitted, index, matrix),
        "settings": {
            "scale_nm": setup.scale_nm,
            "largest_us": float(setup.basis.knots_us[-1]),
            "noise_sd_nm": setup.noise_sd_nm,
            "reference_s": setup.reference_s,
        },
    }


def describe_parameters(fitted: Fitted, index: int, matrix: np.ndarray | None = None) -> dict[str, dict[str, Any]]:
    """Value, sd and unit of an effect's parameters by name."""
    chosen = fitted.problem.chosen[index]
    matrix = fitted.covariance() if matrix is None else matrix
    values = fitted.physical
    return {
        p.name: {"value": float(values[i]), "sd": float(np.sqrt(max(matrix[i, i], 0.0))), "unit": p.unit}
        for i, p in zip(chosen.places, chosen.parameters, strict=True)
    }


def predict(model: Model, record: Record) -> np.ndarray:
    """Free-run torque of a model with effects at a record's samples, N·m, shape (N,).

    What can't be foreseen (bumps, tremor) is given back on the rows it was fitted on alone.

    Raises
    ------
    BadModel
        An effect or its form is unknown here, or the record lacks a column that it needs.
    """
    problem, theta = _problem(model, record)
    unforeseen = frozenset(e["id"] for e in model.effects if not get(e["id"]).foreseeable)
    foreseen = problem.at_samples(theta, unforeseen)
    if not unforeseen or not same_data(model, record):
        return foreseen
    return np.where(record.held_out, foreseen, problem.at_samples(theta))


def grid_slopes(model: Model, record: Record) -> np.ndarray:
    """Derivatives of each interval's mean torque by the parameters of the model's covariance, shape (K, P)."""
    assert model.covariance is not None
    problem, theta = _problem(model, record)
    jacobian = problem.run(theta, derivatives=True)[1]
    assert jacobian is not None
    known = len(model.covariance.names)
    per_unit = np.where(problem.log, problem.physical(theta), 1.0)[:known]
    return (jacobian[:known] / per_unit[:, None]).T


def predict_fitted(fitted: Fitted, record: Record) -> np.ndarray:
    """As `predict`, for a candidate on its own record."""
    fitted = with_band(fitted)
    unforeseen = frozenset(e for e, _ in fitted.effects if not get(e).foreseeable)
    foreseen = fitted.problem.at_samples(fitted.theta, unforeseen)
    if not unforeseen:
        return foreseen
    return np.where(record.held_out, foreseen, fitted.problem.at_samples(fitted.theta))


def _problem(model: Model, record: Record) -> tuple[Problem, np.ndarray]:
    basis = model.recruitment.basis
    if not isinstance(basis, SplineBasis) or not isinstance(model.linear, SecondOrder):
        raise BadModel("effects stand on a spline and a second order only", mend="Fit with maximum-likelihood.")
    grid = make_grid(record)
    settings = model.effects[0]["settings"] if model.effects else {}
    setup = Setup(
        grid=grid,
        target_nm=block_means(grid, record.torque_nm),
        fitted=grid.fitted,
        basis=basis,
        stiffness=1.0,
        scale_nm=float(settings.get("scale_nm", 1.0)),
        noise_sd_nm=float(settings.get("noise_sd_nm", 0.0)),
        delay_bounds_s=(-math.inf, math.inf),
        reference_s=float(settings.get("reference_s", 0.0)),
    )
    effects = []
    values = [model.linear.time_constant_s, model.linear.damping, model.linear.delay_s, model.baseline_nm]
    values += list(model.recruitment.coefficients_nm)
    for entry in model.effects:
        try:
            effect = get(entry["id"])
            form = effect.form(entry.get("form", ""))
            values += [float(_value(entry["parameters"][p.name])) for p in form.parameters]
        except Exception as error:
            raise BadModel(f"{error}", place=f"effects.{entry.get('id')}", mend="Install the effect's file.") from error
        for need in effect.needs:
            if getattr(record, need) is None:
                raise BadModel(f"{effect.id} needs the column {need}", place=need, mend="Record it, or leave it out.")
        effects.append((effect.id, form))
    problem = Problem(setup, effects)
    return problem, problem.from_physical(np.asarray(values, float))


def _value(entry: Any) -> float:
    return entry["value"] if isinstance(entry, dict) else entry
