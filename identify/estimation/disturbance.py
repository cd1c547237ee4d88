"""Torque that no pulse causes, in a short record: a zero that moves, breath, what is left of mains hum.

It is looked for in what the structure leaves, before the structure is said to fit badly: as a sum of waves beside all
parameters of the muscle, slow ones, and the mains' line as the pulses sample it. What a muscle has that the structure
lacks comes and goes with the pulses, and so is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stimrig.identify.effects.base import Form, Parameter
from stimrig.identify.estimation.averaged import averaged
from stimrig.identify.estimation.short_record import Short
from stimrig.identify.estimation.solve import Fitted, gram
from stimrig.identify.estimation.uncertainty import square_root
from stimrig.identify.noise import NoiseLevel
from stimrig.identify.problem.problem import Problem

SLOW_HZ, QUICKEST_HZ, FALL = 0.25, 1.0, 3.0
"""A breath takes two and a half seconds and more: waves above `SLOW_HZ` are smaller by the power `FALL` of their
frequency. What a muscle lacks comes and goes with the pulses, in less than a second."""
HARMONICS = 4
LARGEST = 0.3
"""Largest size of a slow wave, as a share of the largest torque; of its prior one and a half standard deviations."""


def disturbed(short: Short, white_nm: float, mains_hz: float | None) -> tuple[Fitted, np.ndarray]:
    """A fit with a disturbance beside it as a solved problem, and the disturbance, N·m, shape (K,).

    `short`: the fit; `white_nm`: white noise of an interval's mean, N·m; `mains_hz`: frequency of the mains, where the
    samples show hum.
    """
    fitted = averaged(short, mean_of_draws=False)
    setup = fitted.problem.setup
    waves = setup.scale_nm * _waves(setup.scene.time_s, setup.grid.step_s, mains_hz)
    parts = tuple(Parameter(f"wave_{i}", "1", -1.0, 1.0) for i in range(len(waves)))
    problem = Problem(setup, [("disturbance", Form("waves", "additive", "Σ waves", parts))])
    slopes, noise = np.vstack([fitted.slopes, waves]), NoiseLevel(0.0, 0.0, white_nm)
    white = setup.whitened(np.vstack([fitted.residual_nm, slopes]), noise)
    hessian = gram(white[1:]) + problem.prior[1]
    step = np.linalg.solve(hessian, white[1:] @ white[0])
    solved = replace(
        fitted,
        problem=problem,
        theta=np.r_[fitted.theta, np.zeros(len(waves))] + step,
        noise=noise,
        residual_nm=fitted.residual_nm - step @ slopes,
        slopes=slopes,
        hessian=hessian,
    )
    return solved, setup.sign * (step[fitted.theta.size :] @ waves)


def unsure(short: Short, with_disturbance: Fitted) -> Short:
    """The fit of a record without its disturbance, its draws as far apart as the disturbance leaves the muscle open."""
    size, at = short.basis.size, with_disturbance.problem.coefficients
    known = np.r_[0:3, at.start : at.stop]
    muscle = np.arange(at.stop)
    whole = np.linalg.inv(with_disturbance.hessian)[np.ix_(known, known)]
    alone = np.linalg.inv(with_disturbance.hessian[np.ix_(muscle, muscle)])[np.ix_(known, known)]
    normal = np.random.default_rng(len(short.dynamics)).standard_normal((len(short.dynamics), known.size))
    moved = normal @ square_root(whole - alone)
    dynamics = short.dynamics * np.c_[np.exp(moved[:, :2]), np.ones(len(moved))]
    dynamics[:, 2] = np.clip(dynamics[:, 2] + moved[:, 2], *short.grid.delay_bounds_s)
    return replace(short, dynamics=dynamics, coefficients_nm=short.coefficients_nm + moved[:, -size:])


def _waves(time_s: np.ndarray, step_s: float, mains_hz: float | None) -> np.ndarray:
    """Waves that make up a disturbance, each at its largest size, as a share of the largest torque; shape (W, K)."""
    span_s = time_s[-1] - time_s[0] + step_s
    place = (time_s - time_s[0] + 0.5 * step_s) / span_s
    number = np.arange(1, int(2.0 * QUICKEST_HZ * span_s) + 1)[:, None]
    sizes = np.minimum((2.0 * SLOW_HZ * span_s / number) ** FALL, 1.0)
    waves = [place[None, :] - 0.5, sizes * np.cos(np.pi * number * place)]
    if mains_hz is not None:
        turns = {round(abs((h * mains_hz * step_s + 0.5) % 1.0 - 0.5), 2) for h in range(1, HARMONICS + 1)}
        each_hz = [t / step_s + side / span_s for t in turns if t > 2.0 * step_s for side in (-1.0, 0.0, 1.0)]
        turned = 2.0 * np.pi * np.array(each_hz)[:, None] * time_s
        waves += [np.cos(turned), np.sin(turned)]
    return LARGEST * np.vstack(waves)
