"""A narrow band of noise (tremor), written as an effect: a wave with slowly varying amplitude."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stimrig.identify.effects import get, registry
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.noise.level import band_part
from stimrig.identify.simulation.problem import Problem


def band_as_effect(fitted: Fitted) -> Fitted:
    """The candidate with the narrow band of its noise written as the effect `tremor`; unchanged without a band.

    The wave is the smoothed part of the residual that belongs to the band: a cosine and a sine whose amplitudes are
    linear between knots. It describes what was measured and cannot be predicted.
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
    mean, slopes = problem.run(theta, derivatives=True)
    assert slopes is not None
    residual = setup.target_nm - mean
    quiet = replace(fitted.noise, band=0.0, share=fitted.noise.share, sd_nm=float(np.std(residual[setup.fitted])))
    return replace(
        fitted, problem=problem, theta=theta, slopes=slopes, hessian=hessian, residual_nm=residual, noise=quiet
    )


def predict_fitted(fitted: Fitted) -> np.ndarray:
    """Free-run torque of a candidate at its own record's samples, N·m, shape (N,)."""
    record = fitted.problem.setup.grid.record
    fitted = band_as_effect(fitted)
    unpredictable = frozenset(e for e, _ in fitted.effects if not get(e).predictable)
    predictable = fitted.problem.at_samples(fitted.theta, unpredictable)
    if not unpredictable:
        return predictable
    return np.where(record.held_out, predictable, fitted.problem.at_samples(fitted.theta))
