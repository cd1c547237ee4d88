"""Compliance in series: tendon, strap or fixture add a resonance between muscle and load cell."""

from __future__ import annotations

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
SPRING_PARTS = 12
"""Leapfrog steps per interval: at 16 Hz and 40 pulses/s a step is a fifth of a radian."""


@njit(cache=True, nogil=True)
def _follow(x0, v0, omega, damping, toe, step_s):  # pragma: no cover
    """A mass on a spring with a toe, driven by the cubic through boundary states x0 and, times the step, rates v0.

    q'' = ω² (x - z) - 2 ζ ω q', z = q (1 + β q²) is the spring's torque; `toe` is β, 1/(N·m)². Shapes (K, M) and (M,).
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
                v[m] = retained[m] * v[m] + push[m] * (x - z * (1.0 + toe[m] * z * z))
                q[m] = z + 0.5 * h * v[m]
        for m in range(rows):
            if not abs(q[m]) < 1e6:
                q[m], v[m] = 0.0, 0.0
            bent = toe[m] * q[m] * q[m]
            out[k + 1, m], rate[k + 1, m] = q[m] * (1.0 + bent), v[m] * (1.0 + 3.0 * bent)
    return out, rate


def _through_spring(x: Motion, p: Values, scene: Scene, toe: np.ndarray) -> Motion:
    omega, damping = 2 * np.pi * p["resonance_hz"][:, 0], p["damping"][:, 0]
    if np.all(np.isinf(omega)):
        return x
    x0, v0 = np.ascontiguousarray(x[0].T), np.ascontiguousarray((x[1] * scene.step_s).T)
    torque, rate = _follow(x0, v0, omega, damping, toe, scene.step_s)
    return np.ascontiguousarray(torque.T), np.ascontiguousarray(rate.T)


@form("filter", "z'' + 2 ζ ω z' + ω² z = ω² y", *_RESONANCE, kind=_Slow)
def series(x: Motion, p: Values, scene: Scene) -> Motion:
    return _through_spring(x, p, scene, np.zeros(len(x[0])))


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
    """The torque that accelerates the mass is missing from the reading."""
    (y, y_rate), share = x, p["share"]
    z, z_rate = series.call(x, p, scene)
    if z is y:
        return x
    omega, damping = 2 * np.pi * p["resonance_hz"], p["damping"]
    speeding = omega**2 * (y - z) - 2 * damping * omega * z_rate
    mass_torque = (y - z) - 2 * damping * z_rate / omega
    return y - share * mass_torque, y_rate - share * (y_rate - z_rate - 2 * damping * speeding / omega)


@form(
    "filter",
    "q'' + 2 ζ ω q' + ω² (z - y) = 0, z = q (1 + stiffening·q²/y_max²)",
    *_RESONANCE,
    Parameter("stiffening", "1", 0.0, 12.0, 0.0, (1.0,), about="rise of stiffness to full torque"),
    source="toe region of a tendon: Zajac 1989; Duffing's spring",
)
def toe(x: Motion, p: Values, scene: Scene) -> Motion:
    return _through_spring(x, p, scene, p["stiffening"][:, 0] / scene.scale_nm**2)


EFFECT = Effect(
    id="series_compliance",
    name="Compliance in series",
    forms=(series, partly, inertia, toe),
    signature="The torque oscillates after every step.",
    resembles=("electromechanical_delay",),
    separated_by="Steps, at a high sampling rate.",
    plain="Strap, tendon or fixture act as a spring: the torque oscillates after every step. Fasten the limb and the "
    "load cell more firmly.",
    source="A resonance in series with the muscle",
    main={"resonance_hz": "resonance"},
)
