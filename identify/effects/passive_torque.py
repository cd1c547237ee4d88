"""Passive torque of the joint: present without stimulation, depends on angle and velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Apply, Columns, Effect, Form, Parameter, Scene, Values, basis, weighted

SIZES = (3.0, 3.0, 2.0, 2.0, 1.5, 1.0, 1.0, 1.0, 0.7, 0.5, 0.4, 0.3)
"""Sizes of the polynomials of the elastic part; the end of a joint's range bends within a tenth of it."""


def _part(name: str, unit: str, reach: float, about: str, start: tuple[float, ...] = (0.0,)) -> Parameter:
    """A parameter in multiples of the largest torque, of either sign."""
    return Parameter(name, unit, -reach, reach, 0.0, start, relative="torque", about=about)


_STIFF = _part("stiffness_nm_per_rad", "N·m/rad", 3.0, "elastic part, at the reference angle", (0.0, 0.15))
_VISCOUS = _part("viscosity_nm_s_per_rad", "N·m·s/rad", 0.6, "viscous part")


@basis("y + stiffness·Δ + viscosity·velocity, Δ = angle - reference angle", _STIFF, _VISCOUS)
def linear(_p: Values, scene: Scene) -> Columns:
    return {_STIFF.name: scene.away_rad, _VISCOUS.name: scene.speed}


@basis(
    "y + stiffness·Δ + bend·Δ² + hardening·Δ³ + viscosity·velocity",
    _STIFF,
    _part("bend_nm_per_rad2", "N·m/rad²", 3.0, "one-sided part"),
    _part("hardening_nm_per_rad3", "N·m/rad³", 4.5, "stiffening at both ends"),
    _VISCOUS,
)
def two_sided(_p: Values, scene: Scene) -> Columns:
    away = scene.away_rad
    elastic = {_STIFF.name: away, "bend_nm_per_rad2": away**2, "hardening_nm_per_rad3": away**3}
    return elastic | {_VISCOUS.name: scene.speed}


_FREE = (
    *(_part(f"elastic_{i}_nm", "N·m", size, f"polynomial {i}") for i, size in enumerate(SIZES, start=1)),
    _VISCOUS,
    replace(_VISCOUS, name="tilt_nm_s_per_rad", about="viscosity's slope over the range"),
    replace(_VISCOUS, name="bow_nm_s_per_rad", about="viscosity's curvature over the range"),
    _part("dry_nm", "N·m", 0.5, "dry friction"),
    Parameter("dry_below_rad_s", "rad/s", 0.01, 0.5, 0.07, (0.07,), "log", about="where it is less than that"),
    Parameter("inertia_nm_s2_per_rad", "N·m·s²/rad", -0.5, 0.5, 0.0, (0.0,), about="of what the cell moves"),
)


def _surface(p: Values, scene: Scene) -> Columns:
    velocity, place = scene.speed, scene.place
    acceleration = np.zeros_like(velocity) if scene.acceleration_rad_s2 is None else scene.acceleration_rad_s2
    below_rad_s, row = np.unique(p["dry_below_rad_s"], return_inverse=True)
    return {f"elastic_{i}_nm": bend for i, bend in enumerate(scene.bends(len(SIZES)), start=1)} | {
        _VISCOUS.name: velocity,
        "tilt_nm_s_per_rad": place * velocity,
        "bow_nm_s_per_rad": place**2 * velocity,
        "dry_nm": np.tanh(velocity / below_rad_s[:, None])[row.ravel()],
        "inertia_nm_s2_per_rad": acceleration,
    }


def _relaxing(p: Values, scene: Scene) -> Columns:
    """As `surface`, and a spring behind a dashpot."""
    away = scene.away_rad
    begins = np.zeros(away.size, bool) if scene.begins is None else scene.begins
    time_constants, row = np.unique(p["relaxation_s"], return_inverse=True)
    followed = relaxed(away, scene.time_s, begins, time_constants)
    return _surface(p, scene) | {"relaxing_nm_per_rad": away - followed[row.ravel()]}


def _over_intervals(columns: Callable[[Values, Scene], Columns]) -> Apply:
    """Average over each pulse interval: where a joint turns round, dry friction has both signs within one."""

    def apply(_: None, p: Values, scene: Scene) -> np.ndarray:
        at = scene.within or scene
        torque = weighted(p, columns(p, at))
        return torque.reshape(len(torque), scene.time_s.size, -1).mean(axis=2)

    return apply


@njit(cache=True, nogil=True)
def relaxed(value, time_s, begins, relaxation_s):  # pragma: no cover
    """First-order lags of a value, exact for a value that is linear between points; shape (M, K).

    `value` and `time_s`, (K,), are what is followed, and when; it has already arrived where a recording `begins`, (K,).
    `relaxation_s`, (M,), are the lags' time constants.
    """
    rows, size = relaxation_s.size, value.size
    out = np.empty((rows, size))
    for m in range(rows):
        z = value[0]
        out[m, 0] = z
        for k in range(1, size):
            step_s = time_s[k] - time_s[k - 1]
            if begins[k] or not step_s > 0.0:
                z = value[k]
            else:
                lag_s = relaxation_s[m]
                slope = (value[k] - value[k - 1]) / step_s
                z = value[k] - slope * lag_s + (z - value[k - 1] + slope * lag_s) * np.exp(-step_s / lag_s)
            out[m, k] = z
    return out


surface = Form(
    "surface",
    "additive",
    "y + Σ elastic_k (T_k(x) - T_k(reference)) + (viscosity + tilt·x + bow·x²)·velocity + dry·tanh(velocity/below) + "
    "inertia·acceleration, x: place in the fitted range, -1 to 1",
    _FREE,
    _over_intervals(_surface),
    batched=True,
    source="shape free: Riener and Edrich 1999 for what it has to follow; Coulomb friction; Newton",
)
relaxing = Form(
    "relaxing",
    "additive",
    "surface + relaxing·(Δ - z), z' = (Δ - z)/relaxation",
    (
        *_FREE,
        replace(_STIFF, name="relaxing_nm_per_rad", start=(0.0,), about="stiffness that gives way"),
        Parameter("relaxation_s", "s", 0.3, 10.0, 1.0, (1.0,), "log", about="time in which it does"),
    ),
    _over_intervals(_relaxing),
    batched=True,
    source="standard linear solid, Fung 1981",
)

EFFECT = Effect(
    id="passive_torque",
    name="Passive torque of the joint",
    forms=(linear, two_sided, surface, relaxing),
    signature="Torque that follows the movement, also without stimulation.",
    resembles=("baseline_drift", "torque_velocity"),
    separated_by="Passive movement without stimulation.",
    plain="The joint resists movement also without stimulation: stiffness and, after a stroke, spasticity.",
    source="Riener et al. 1996",
    needs=("angle_rad",),
    main={"stiffness_nm_per_rad": "stiffness", "elastic_1_nm": "elastic torque over the angle"},
)
