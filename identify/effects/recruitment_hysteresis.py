"""Hysteresis of recruitment: rising and falling pulse widths give different torques."""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_HALF = Parameter("half_width_us", "µs", 0.0, 45.0, 0.0, (8.0, 20.0), about="half the distance between the two curves")
_REACH = Parameter(
    "reach_us", "µs", 1.0, 80.0, 10.0, (4.0, 25.0), "log", about="change of width after which the other curve holds"
)
_EACH_WAY = "Durfee, MacLean 1989: a curve for each direction"
_LEVELS = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)


@njit(cache=True, nogil=True)
def _play(width_us: np.ndarray, half_us: np.ndarray, growth_per_us: np.ndarray) -> np.ndarray:  # pragma: no cover
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
def _dahl(width_us: np.ndarray, reach_us: np.ndarray) -> np.ndarray:  # pragma: no cover
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


def _direction(width: np.ndarray, p: Values) -> np.ndarray:
    return _dahl(np.ascontiguousarray(width), p["reach_us"][:, 0])


@form("pulse_width", "w = f(p); p = max(u - r, min(u + r, p_before)), r = half_width", _HALF)
def play(width: np.ndarray, p: Values, _scene: Scene) -> np.ndarray:
    half = p["half_width_us"][:, 0]
    return _play(np.ascontiguousarray(width), half, np.zeros_like(half))


@form(
    "pulse_width",
    "as play, with r = half_width (1 + growth·u/u_max)",
    _HALF,
    Parameter("growth", "1", -0.9, 4.0, 0.0, (1.0, 0.0), about="wider at larger widths"),
)
def widening(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _play(np.ascontiguousarray(width), p["half_width_us"][:, 0], p["growth"][:, 0] / scene.largest_us)


@form(
    "pulse_width",
    "w = f(u + share (p - u)), p: mean of five play operators with r up to half_width",
    Parameter("share", "1", 0.0, 1.6, 0.0, (0.4, 0.9), about="share of motor units with hysteresis"),
    Parameter("half_width_us", "µs", 3.0, 150.0, 20.0, (50.0, 15.0), "log", about="widest play"),
    source="Prandtl and Ishlinskii; Preisach's plane with an even distribution",
)
def distributed(width: np.ndarray, p: Values, _scene: Scene) -> np.ndarray:
    half, rows = p["half_width_us"], np.ascontiguousarray(width)
    even = np.zeros(rows.shape[0])
    plays = (_play(rows, share * half[:, 0], even) for share in (0.2, 0.4, 0.6, 0.8, 1.0))
    return rows + p["share"] * (sum(plays, np.zeros_like(rows)) / 5.0 - rows)


@form(
    "pulse_width",
    "w = f(u - half_width·z); dz = (du - z|du|)/reach",
    _HALF,
    _REACH,
    source="Dahl's friction as direction memory; Bouc, Wen",
)
def memory(width: np.ndarray, p: Values, _scene: Scene) -> np.ndarray:
    return np.where(width > 0, width - p["half_width_us"] * _direction(width, p), width)


@form(
    "pulse_width",
    "w = f(u - z (half_width + tilt (s - 1/2) + bend (s - 1/2)²)), s = u/u_max; dz = (du - z|du|)/reach",
    Parameter("half_width_us", "µs", -45.0, 45.0, 0.0, (8.0,), about="half the distance in the middle"),
    Parameter("tilt_us", "µs", -60.0, 60.0, 0.0, (0.0,), about="wider towards large widths"),
    Parameter("bend_us", "µs", -120.0, 120.0, 0.0, (0.0,), about="wider at both ends"),
    _REACH,
    source=_EACH_WAY,
)
def two_curves(width: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    z = _direction(width, p)
    part = width / scene.largest_us
    half = p["half_width_us"] + p["tilt_us"] * (part - 0.5) + p["bend_us"] * (part - 0.5) ** 2
    return np.where(width > 0, width - half * z, width)


@form(
    "gain",
    "w = f(u) - z·gap(f), gap: linear between six levels of torque; dz = (du - z|du|)/reach",
    *(
        Parameter(f"gap_{i}_nm", "N·m", -0.2, 0.2, 0.0, (0.02,), "linear", "torque", f"at {level:.0%}")
        for i, level in enumerate(_LEVELS)
    ),
    _REACH,
    source=_EACH_WAY,
)
def difference(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """Two curves whose difference is free at six levels of torque."""
    level = drive / scene.scale_nm
    gap = np.zeros_like(drive)
    for i, centre in enumerate(_LEVELS):
        gap = gap + p[f"gap_{i}_nm"] * np.maximum(1.0 - np.abs(level - centre) / 0.15, 0.0)
    return drive - _direction(np.broadcast_to(scene.pulse_width_us, drive.shape), p) * gap


@form(
    "gain",
    "w = (1 - share·z) f(u); dz = (du - z|du|)/reach",
    Parameter("share", "1", -0.6, 0.6, 0.0, (0.08, -0.08), about="half the difference"),
    _REACH,
)
def gain(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return drive * (1.0 - p["share"] * _direction(np.broadcast_to(scene.pulse_width_us, drive.shape), p))


EFFECT = Effect(
    id="recruitment_hysteresis",
    name="Hysteresis of recruitment",
    forms=(play, widening, distributed, memory, two_curves, difference, gain),
    signature="At equal pulse widths: torque below the model while the width rises, above it while it falls.",
    resembles=("voluntary_effort", "threshold_drift", "fatigue", "asymmetric_relaxation"),
    separated_by="Two ramps of different speed: hysteresis is equal in both; a slow muscle or fatigue is not.",
    plain="The same pulse width gives different torques when it rises and when it falls. Without this in the model, "
    "the controller's error is the distance between the two curves.",
    source="Durfee, MacLean 1989: deconvolution of a ramp gives one curve for each direction",
    prior=-2.5,
    main={"half_width_us": "half width", "share": "share", "gap_0_nm": "gap at small widths"},
)
