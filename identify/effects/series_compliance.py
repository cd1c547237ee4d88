"""Compliance in series: tendon, strap or fixture add a resonance between muscle and load cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values, form

Motion = tuple[np.ndarray, np.ndarray]
"""Torque and its rate."""


class _Slow(Form):
    """A form of a slow resonance, which a model without it imitates by slow dynamics."""

    def starts(self, scene: Scene) -> list[dict[str, float]]:
        slow = {"damping": 0.15, "share": 0.4, "base.damping": 1.0}
        further = [{"resonance_hz": hz, "base.time_constant_s": t} for hz, t in ((1.6, 0.1), (3.0, 0.15))]
        return super().starts(scene) + [start | slow for start in further]


_RESONANCE = (
    Parameter("resonance_hz", "Hz", 1.2, 16.0, np.inf, (3.0, 6.0, 10.0), "log", about="resonance of the series spring"),
    Parameter("damping", "1", 0.02, 0.7, 0.2, (0.15,), "log", about="damping of the resonance, 1 is critical"),
)
_STIFFENING = Parameter("stiffening", "1", 0.0, 12.0, 0.0, (1.0,), about="rise of stiffness to full torque")


@njit(cache=True, nogil=True)
def _follow(state: np.ndarray, phi: np.ndarray, forced: np.ndarray) -> np.ndarray:  # pragma: no cover
    """States of x[k + 1] = phi x[k] + forced[k]; shapes (M, 2), (M, 2, 2), (M, K, 2); to (2, M, K + 1)."""
    rows, size = forced.shape[:2]
    out = np.empty((2, rows, size + 1))
    for m in range(rows):
        z, v = state[m]
        out[0, m, 0], out[1, m, 0] = z, v
        for k in range(size):
            z, v = (
                phi[m, 0, 0] * z + phi[m, 0, 1] * v + forced[m, k, 0],
                phi[m, 1, 0] * z + phi[m, 1, 1] * v + forced[m, k, 1],
            )
            out[0, m, k + 1], out[1, m, k + 1] = z, v
    return out


def _steps(frequency_hz: float, damping: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition of z'' = ω²(x - z) - 2ζω z', where x is the cubic between the states (x, x') at both ends."""
    from scipy.linalg import expm  # here: its import takes as long as a fit, which mostly does not need it

    omega = 2 * np.pi * frequency_hz * step_s
    system = np.zeros((6, 6))
    system[0, 1] = 1.0
    system[1, :3] = [-(omega**2), -2 * damping * omega, omega**2]
    system[2, 3] = system[3, 4] = system[4, 5] = 1.0
    phi = expm(system)
    # Time in steps: the cubic's derivatives at the start, from x0, x0', x1, x1'.
    cubic = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [-6, -4, 6, -2], [12, 6, -12, 6]], float)
    return phi[:2, :2], phi[:2, 2:] @ cubic


@form("filter", "z'' + 2 ζ ω z' + ω² z = ω² y", *_RESONANCE, kind=_Slow)
def series(x: Motion, p: Values, scene: Scene) -> Motion:
    torque, rate = x
    frequency, damping = p["resonance_hz"][:, 0], p["damping"][:, 0]
    if np.all(np.isinf(frequency)):
        return x
    pairs = list(zip(frequency.tolist(), damping.tolist(), strict=True))
    known = {pair: _steps(*pair, scene.step_s) for pair in set(pairs)}
    phi, gamma = (np.stack(matrices) for matrices in zip(*(known[pair] for pair in pairs), strict=True))
    slope = rate * scene.step_s
    ends = np.stack([torque[:, :-1], slope[:, :-1], torque[:, 1:], slope[:, 1:]], axis=2)
    begin = np.stack([torque[:, 0], np.zeros(len(torque))], axis=1)
    z, v = _follow(begin, phi, ends @ gamma.transpose(0, 2, 1))
    return z, v / scene.step_s


@form(
    "filter",
    "y + share (z - y), z as in series",
    *_RESONANCE,
    Parameter("share", "1", 0.0, 1.0, 0.0, (0.5,), about="share of torque through the spring"),
    grows=True,
    kind=_Slow,
)
def partly(x: Motion, p: Values, scene: Scene) -> Motion:
    torque, rate = series.call(x, p, scene)
    share = p["share"]
    return x[0] + share * (torque - x[0]), x[1] + share * (rate - x[1])


@form(
    "filter",
    "y - share·z''/ω², z as in series: the load cell also carries the mass",
    *_RESONANCE,
    Parameter("share", "1", 0.0, 1.5, 0.0, (0.5,), about="share of the mass that the load cell carries"),
    grows=True,
)
def inertia(x: Motion, p: Values, scene: Scene) -> Motion:
    """The load cell also carries the mass: the torque that accelerates it is missing from the reading."""
    (y, y_rate), share = x, p["share"]
    z, z_rate = series.call(x, p, scene)
    if z is y:
        return x
    omega, damping = 2 * np.pi * p["resonance_hz"], p["damping"]
    speeding = omega**2 * (y - z) - 2 * damping * omega * z_rate
    mass_torque = (y - z) - 2 * damping * z_rate / omega
    return y - share * mass_torque, y_rate - share * (y_rate - z_rate - 2 * damping * speeding / omega)


SPRING_PARTS = 12
"""Leapfrog steps per interval: at 16 Hz and 40 pulses/s a step is a fifth of a radian."""


@njit(cache=True, nogil=True)
def _follow_curved(
    x0: np.ndarray,
    v0: np.ndarray,
    omega: np.ndarray,
    damping: np.ndarray,
    curved: np.ndarray,
    toe: bool,
    step_s: float,
) -> tuple[np.ndarray, np.ndarray]:  # pragma: no cover
    """A mass on a nonlinear spring, driven by the cubic through boundary states x0 and, times the step, rates v0.

    With a toe q'' = ω² (x - z) - 2 ζ ω q', z = q (1 + β q²) the spring's torque; else z'' = ω² (1 + β |z|)(x - z) -
    2 ζ ω z'. Shapes (K, M) and (M,); β in 1/(N·m)² or 1/(N·m).
    """
    size, rows = x0.shape
    h = step_s / SPRING_PARTS
    out, rate = np.zeros((size, rows)), np.zeros((size, rows))
    q, v, retained, push = np.zeros(rows), np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for m in range(rows):
        q[m] = out[0, m] = x0[0, m]
        c = damping[m] * omega[m] * h
        retained[m], push[m] = (1.0 - c) / (1.0 + c), h * omega[m] * omega[m] / (1.0 + c)
    for k in range(size - 1):
        for i in range(SPRING_PARTS):
            s = (i + 0.5) / SPRING_PARTS
            a, b = (1 + 2 * s) * (1 - s) * (1 - s), s * (1 - s) * (1 - s)
            d, e = s * s * (3 - 2 * s), s * s * (s - 1)
            for m in range(rows):
                x = a * x0[k, m] + b * v0[k, m] + d * x0[k + 1, m] + e * v0[k + 1, m]
                z = q[m] + 0.5 * h * v[m]
                force = x - z * (1.0 + curved[m] * z * z) if toe else (1.0 + curved[m] * abs(z)) * (x - z)
                v[m] = retained[m] * v[m] + push[m] * force
                q[m] = z + 0.5 * h * v[m]
        for m in range(rows):
            if not abs(q[m]) < 1e6:
                q[m], v[m] = 0.0, 0.0
            bent = curved[m] * q[m] * q[m] if toe else 0.0
            out[k + 1, m] = q[m] * (1.0 + bent)
            rate[k + 1, m] = v[m] * (1.0 + 3.0 * bent)
    return out, rate


def _curved(x: Motion, p: Values, scene: Scene, toe: bool) -> Motion:
    frequency = p["resonance_hz"][:, 0]
    if np.all(np.isinf(frequency)):
        return x
    beta = p["stiffening"][:, 0] / scene.scale_nm ** (2 if toe else 1)
    x0, v0 = np.ascontiguousarray(x[0].T), np.ascontiguousarray((x[1] * scene.step_s).T)
    states = _follow_curved(x0, v0, 2 * np.pi * frequency, p["damping"][:, 0], beta, toe, scene.step_s)
    return np.ascontiguousarray(states[0].T), np.ascontiguousarray(states[1].T)


@form(
    "filter",
    "q'' + 2 ζ ω q' + ω² (z - y) = 0, z = q (1 + stiffening·q²/y_max²)",
    *_RESONANCE,
    _STIFFENING,
    source="toe region of a tendon: Zajac 1989; Duffing's spring",
)
def toe(x: Motion, p: Values, scene: Scene) -> Motion:
    return _curved(x, p, scene, True)


@form(
    "filter",
    "z'' + 2 ζ ω z' + ω² (1 + stiffening·|z|/y_max) (z - y) = 0",
    *_RESONANCE,
    replace(_STIFFENING, lower=-0.6),
    grows=True,
)
def stiffening(x: Motion, p: Values, scene: Scene) -> Motion:
    return _curved(x, p, scene, False)


EFFECT = Effect(
    id="series_compliance",
    name="Compliance in series",
    forms=(series, partly, inertia, toe, stiffening),
    signature="The torque oscillates after every step.",
    resembles=("electromechanical_delay",),
    separated_by="Steps, at a high sampling rate.",
    plain="Strap, tendon or fixture act as a spring: the torque oscillates after every step. Fasten the limb and the "
    "load cell more firmly.",
    source="A resonance in series with the muscle",
    main={"resonance_hz": "resonance"},
)
