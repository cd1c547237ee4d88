"""Hysteresis of recruitment: rising and falling pulse widths give different torques."""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form


@njit(cache=True, nogil=True)
def _play(width_us, half_us, growth_per_us):  # pragma: no cover
    """Play operator: the output stays within half (1 + growth·input) of the input; it starts at 0.

    Shapes (M, K), (M,), (M,).
    """
    rows, size = width_us.shape
    out = np.empty((rows, size))
    for m in range(rows):
        p = 0.0
        for k in range(size):
            u = width_us[m, k]
            half = half_us[m] * max(1.0 + growth_per_us[m] * u, 0.0)
            p = max(u - half, min(u + half, p))
            out[m, k] = p
    return out


@njit(cache=True, nogil=True)
def _dahl(width_us, reach_us):  # pragma: no cover
    """Dahl's friction, a memory of direction z in [-1, 1]: dz = (du - z |du|)/reach. Shapes (M, K), (M,).

    Before the first change z is 0.
    """
    rows, size = width_us.shape
    out = np.empty((rows, size))
    for m in range(rows):
        z, last = 0.0, 0.0
        for k in range(size):
            change = width_us[m, k] - last
            last = width_us[m, k]
            if change != 0.0:
                goal = 1.0 if change > 0.0 else -1.0
                z = goal + (z - goal) * np.exp(-abs(change) / reach_us[m])
            out[m, k] = z
    return out


@form(
    "pulse_width",
    "w = f(p); p = max(u - r, min(u + r, p_before)), r = half_width (1 + growth·u/u_max)",
    Parameter("half_width_us", "µs", 0.0, 45.0, 0.0, (8.0, 20.0), about="half the distance between the two curves"),
    Parameter("growth", "1", -0.9, 4.0, 0.0, (1.0, 0.0), about="wider at larger widths"),
)
def widening(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _play(np.ascontiguousarray(width), p["half_width_us"][:, 0], p["growth"][:, 0] / scene.largest_us)


@form(
    "pulse_width",
    "w = f(u - z (half_width + tilt (s - 1/2) + bend (s - 1/2)²)), s = u/u_max; dz = (du - z|du|)/reach",
    Parameter("half_width_us", "µs", -45.0, 45.0, 0.0, (8.0,), about="half the distance in the middle"),
    Parameter("tilt_us", "µs", -60.0, 60.0, 0.0, (0.0,), about="wider towards large widths"),
    Parameter("bend_us", "µs", -120.0, 120.0, 0.0, (0.0,), about="wider at both ends"),
    Parameter("reach_us", "µs", 1.0, 80.0, 10.0, (4.0, 25.0), "log", about="change until the other curve holds"),
    source="Durfee, MacLean 1989: a curve for each direction",
)
def two_curves(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    z = _dahl(np.ascontiguousarray(width), p["reach_us"][:, 0])
    part = width / scene.largest_us
    half = p["half_width_us"] + p["tilt_us"] * (part - 0.5) + p["bend_us"] * (part - 0.5) ** 2
    return np.where(width > 0, width - half * z, width)


EFFECT = Effect(
    id="recruitment_hysteresis",
    name="Hysteresis of recruitment",
    forms=(widening, two_curves),
    signature="At equal pulse widths: torque below the model while the width rises, above it while it falls.",
    resembles=("voluntary_effort", "threshold_drift", "fatigue", "asymmetric_relaxation"),
    separated_by="Two ramps of different speed: hysteresis is equal in both; a slow muscle or fatigue is not.",
    plain="The same pulse width gives different torques when it rises and when it falls. Without this in the model, "
    "the controller's error is the distance between the two curves.",
    source="Durfee, MacLean 1989: deconvolution of a ramp gives one curve for each direction",
    prior=-2.5,
    main={"half_width_us": "half width"},
)
