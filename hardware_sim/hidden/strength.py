"""Strength of a hidden effect: the residual of the best Hammerstein model without effects, on a noise-free record;
and the magnitude that gives a wanted strength.

A cubic spline with many knots, then a second-order system, fitted by variable projection (Golub and Pereyra 1973) at
the pulse rate. Half of the knots lie where the base really rises, which the identification cannot know. Held-out rows
are not fitted. This only sets the magnitude of a hidden effect; no verdict depends on it.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from stimrig.hardware_sim.hidden.base import Base
from stimrig.hardware_sim.hidden.chain import combine, simulate
from stimrig.hardware_sim.hidden.design import Design
from stimrig.hardware_sim.hidden.forms import Counted, Form
from stimrig.hardware_sim.hidden.kernels import Floats, NotSuited, Stage, helper

PULSE_RATE_HZ = 40.0
STEP_S = 1.0 / 1600.0
STIFFNESS = 1e-3
"""Weight of the coefficients' second differences, over the mean square of a basis column's response."""


def _knots(base: Base, count: int = 40) -> Floats:
    """Interior and end knots over the widths sent: half evenly, half where the base rises."""
    top = float(base.largest_width_us)
    u = np.arange(base.largest_width_us + 1, dtype=np.float64)
    rising = np.maximum.accumulate(base.table_nm[: u.size]) + 1e-6 * u
    by_rise = np.interp(np.linspace(0.0, 1.0, count // 2), rising / rising[-1], u)
    inner = np.unique(np.round(np.concatenate([np.linspace(0.0, top, count // 2), by_rise]), 1))
    kept_knots = [inner[0]]
    for knot in inner[1:]:
        if knot - kept_knots[-1] >= 1.0:
            kept_knots.append(knot)
    kept_knots[-1] = top
    return np.concatenate([[0.0] * 3, kept_knots, [top] * 3])


def _filter(t_omega_s: float, zeta: float, step_s: float) -> tuple[Floats, Floats]:
    """Exact zero-order-hold discretisation of 1 / (Tω² s² + 2 ζ Tω s + 1); output before the input acts."""
    wn, root = 1.0 / t_omega_s, np.sqrt(complex(zeta * zeta - 1.0))
    if abs(root) < 1e-6:
        root = complex(1e-6)
    s1, s2 = wn * (-zeta + root), wn * (-zeta - root)
    e1, e2 = np.exp(s1 * step_s), np.exp(s2 * step_s)
    a1, a2 = (e1 + e2).real, (e1 * e2).real
    # step response 1 - (s2 e^(s1 t) - s1 e^(s2 t)) / (s2 - s1), sampled, gives the numerator
    y1 = (1.0 - (s2 * e1 - s1 * e2) / (s2 - s1)).real
    b2 = 1.0 - a1 + a2 - y1
    return np.array([0.0, y1, b2]), np.array([1.0, -a1, a2])


# Loops instead of a linear-algebra library, whose threads wait for one another if several processes share few cores.
@helper
def _normal_equations(basis, b, a, y, fitted):
    """Filter each column (second order, no feed-through); lower Gram matrix and moments over the rows to fit."""
    n, m = basis.shape
    x = np.zeros((n, m))
    gram = np.zeros((m, m))
    moment = np.zeros(m)
    for k in range(1, n):
        for j in range(m):
            value = b[1] * basis[k - 1, j] - a[1] * x[k - 1, j]
            if k > 1:
                value += b[2] * basis[k - 2, j] - a[2] * x[k - 2, j]
            x[k, j] = value
        if fitted[k]:
            for i in range(m):
                xi = x[k, i]
                moment[i] += xi * y[k]
                for j in range(i + 1):
                    gram[i, j] += xi * x[k, j]
    return x, gram, moment


@helper
def _product(x, coefficients):
    n, m = x.shape
    out = np.zeros(n)
    for k in range(n):
        for j in range(m):
            out[k] += x[k, j] * coefficients[j]
    return out


class EffectFreeFit:
    """The effect-free fit for one design at the pulse rate, with knots and starting values from a base."""

    def __init__(self, base: Base, design: Design) -> None:
        self._fitted = ~design.held_out
        knots = _knots(base)
        u = np.clip(design.width_us, 0.0, knots[-1])
        basis = BSpline.design_matrix(u, knots, 3).toarray()[:, 1:]  # f(0) = 0
        self._basis = np.ascontiguousarray(basis[:, basis[self._fitted].any(axis=0)])
        bend = np.diff(np.eye(self._basis.shape[1] + 1), 2, axis=0)[:, 1:]  # the coefficient left out is zero
        self._bend = bend.T @ bend
        self._starts = [np.log([base.t_omega_s, base.zeta])] * 2

    def _predict(self, theta: Floats, torque_nm: Floats) -> Floats:
        b, a = _filter(float(np.exp(theta[0])), float(np.exp(theta[1])), 1.0 / PULSE_RATE_HZ)
        x, gram, moment = _normal_equations(self._basis, b, a, torque_nm, self._fitted)
        gram += np.tril(gram, -1).T
        weight = np.trace(gram) / len(gram)
        gram += STIFFNESS * weight * self._bend
        gram[np.diag_indices_from(gram)] += 1e-9 * weight
        return _product(x, np.asarray(cho_solve(cho_factor(gram), moment)))

    def fit(self, torque_nm: Floats) -> Floats:
        """Residual of the best effect-free model over all rows, free run, N·m."""
        of_base, of_last = self._starts  # the last fit's end may be a local minimum for the next
        results = [
            least_squares(
                lambda theta: (torque_nm - self._predict(theta, torque_nm))[self._fitted],
                start,
                bounds=(np.log([0.004, 0.08]), np.log([4.0, 12.0])),
                x_scale=(0.3, 0.3),
                diff_step=1e-4,
                max_nfev=20,
                xtol=1e-4,
                ftol=1e-5,
            )
            for start in ([of_base] if np.array_equal(of_base, of_last) else [of_last, of_base])
        ]
        best = min(results, key=lambda result: result.cost)
        self._starts[1] = best.x
        return torque_nm - self._predict(best.x, torque_nm)


def excess_nm(counted: Counted, residual_nm: Floats, held_out: np.ndarray) -> dict[str, float]:
    """Root mean squares of the residual: training rows, held-out rows, all rows, and the one that counts."""
    rms = lambda rows: float(np.sqrt(np.mean(rows**2))) if rows.size else float("nan")  # noqa: E731
    training, held_out_rms, everywhere = rms(residual_nm[~held_out]), rms(residual_nm[held_out]), rms(residual_nm)
    if counted == "all" or not held_out.any():
        counts = everywhere
    else:
        counts = {"training": training, "larger": max(training, held_out_rms)}.get(counted, held_out_rms)
    return {"training_nm": training, "held_out_nm": held_out_rms, "all_nm": everywhere, "counted_nm": counts}


def find_magnitude(
    counted: Counted,
    form: Form,
    base: Base,
    design: Design,
    target_nm: float,
    band_nm: tuple[float, float],
) -> tuple[float, dict[str, float]]:
    """Magnitude at which the excess is about `target_nm` and within the band, and that excess.

    By secant steps in the logarithm, kept within a bracket.

    Raises NotSuited: the excess of the largest magnitude is too small, or the fit without the effect too poor.
    """
    effect_free = EffectFreeFit(base, design)

    def residual(stages: list[Stage]) -> tuple[Floats, dict[str, float]]:
        torque = simulate(base, stages, design, STEP_S)
        if not np.all(np.isfinite(torque)):
            raise NotSuited("the simulation diverged")
        every = round(1.0 / PULSE_RATE_HZ / STEP_S)
        return torque, excess_nm(counted, effect_free.fit(torque[::every]), design.held_out)

    def excess_at(magnitude: float) -> dict[str, float]:
        """Excess in N·m; the error without the effect is taken out of `counted_nm`."""
        torque, fit = residual(combine(base, [(form, magnitude)]))
        left_nm = float(np.sqrt(max(fit["counted_nm"] ** 2 - own_nm**2, 1e-18)))
        return fit | {"counted_nm": float(np.std(torque - without)) if counted == "added" else left_nm}

    without, fit = residual(base.stages())
    own_nm = fit["counted_nm"]  # what the fit leaves without any effect
    if own_nm > 0.5 * target_nm:
        raise NotSuited("the effect-free fit follows this base too poorly")
    high = form.largest_magnitude
    at_high = excess_at(high)["counted_nm"]
    if at_high < target_nm:
        raise NotSuited("too small even at its largest magnitude")
    low, at_low = high * 1e-3, target_nm * 1e-3
    magnitude = high * target_nm / at_high
    for tries in range(12):
        excess = excess_at(magnitude)
        shown_nm = excess["counted_nm"]
        close = abs(np.log(shown_nm / target_nm)) < (0.1 if tries < 6 else 1.0)
        if close and band_nm[0] * 1.03 < shown_nm < band_nm[1] * 0.97:
            return magnitude, excess
        if shown_nm > target_nm:
            high, at_high = magnitude, shown_nm
        else:
            low, at_low = magnitude, max(shown_nm, 1e-9)
        slope = np.log(at_high / at_low) / np.log(high / low)
        step = np.log(target_nm / shown_nm) / np.clip(slope, 0.4, 4.0)
        edge = 0.03 * np.log(high / low)
        magnitude = float(np.exp(np.clip(np.log(magnitude) + step, np.log(low) + edge, np.log(high) - edge)))
    raise NotSuited("the effect's size does not grow smoothly")
