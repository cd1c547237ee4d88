"""Compliance in series: tendon, strap or fixture add a resonance between muscle and load cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene
from stimrig.identify.effects.kernels import exponential, follow, follow_curved

_RESTARTS = tuple(
    {"resonance_hz": hz, "damping": 0.15, "share": 0.4, "base.time_constant_s": t, "base.damping": 1.0}
    for hz, t in ((1.6, 0.1), (3.0, 0.15))
)
_RESONANCE = (
    Parameter("resonance_hz", "Hz", 1.2, 16.0, np.inf, (3.0, 6.0, 10.0), "log", about="resonance of the series spring"),
    Parameter("damping", "1", 0.02, 0.7, 0.2, (0.15,), "log", about="damping of the resonance, 1 is critical"),
)
_STIFFENING = Parameter("stiffening", "1", 0.0, 12.0, 0.0, (1.0,), about="rise of stiffness to full torque")


def _steps(frequency_hz: float, damping: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition of z'' = ω²(x - z) - 2ζω z', where x is the cubic between the states (x, x') at both ends."""
    omega = 2 * np.pi * frequency_hz * step_s
    system = np.zeros((6, 6))
    system[0, 1] = 1.0
    system[1, :3] = [-(omega**2), -2 * damping * omega, omega**2]
    system[2, 3] = system[3, 4] = system[4, 5] = 1.0
    phi = exponential(system)
    # Time in steps: the cubic's derivatives at the start, from x0, x0', x1, x1'.
    cubic = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [-6, -4, 6, -2], [12, 6, -12, 6]], float)
    return phi[:2, :2], phi[:2, 2:] @ cubic


def _series(x: tuple[np.ndarray, np.ndarray], p: dict[str, Any], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    torque, rate = x
    frequency, damping = p["resonance_hz"][:, 0], p["damping"][:, 0]
    if np.all(np.isinf(frequency)):
        return x
    pairs = list(zip(frequency.tolist(), damping.tolist(), strict=True))
    known = {pair: _steps(*pair, scene.step_s) for pair in set(pairs)}
    phi, gamma = (np.stack(matrices) for matrices in zip(*(known[pair] for pair in pairs), strict=True))
    return follow(torque, rate * scene.step_s, phi, gamma, scene.step_s)


def _partly(x: tuple[np.ndarray, np.ndarray], p: dict[str, Any], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    torque, rate = _series(x, p, scene)
    share = p["share"]
    return x[0] + share * (torque - x[0]), x[1] + share * (rate - x[1])


def _inertia(x: tuple[np.ndarray, np.ndarray], p: dict[str, Any], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The load cell also carries the mass: the torque that accelerates it is missing from the reading."""
    (y, y_rate), share = x, p["share"]
    z, z_rate = _series(x, p, scene)
    if z is y:
        return x
    omega, damping = 2 * np.pi * p["resonance_hz"], p["damping"]
    speeding = omega**2 * (y - z) - 2 * damping * omega * z_rate
    taken = (y - z) - 2 * damping * z_rate / omega
    return y - share * taken, y_rate - share * (y_rate - z_rate - 2 * damping * speeding / omega)


def _curved(toe: bool) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    def apply(x: tuple[np.ndarray, np.ndarray], p: dict[str, Any], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        frequency = p["resonance_hz"][:, 0]
        if np.all(np.isinf(frequency)):
            return x
        beta = p["stiffening"][:, 0] / scene.scale_nm ** (2 if toe else 1)
        damping = p["damping"][:, 0]
        return follow_curved(x[0], x[1] * scene.step_s, 2 * np.pi * frequency, damping, beta, toe, scene.step_s)

    return apply


EFFECT = Effect(
    id="series_compliance",
    name="Compliance in series",
    forms=(
        Form("series", "filter", "z'' + 2 ζ ω z' + ω² z = ω² y", _RESONANCE, _series, True, restarts=_RESTARTS),
        Form(
            "partly",
            "filter",
            "y + share (z - y), z as in series",
            (*_RESONANCE, Parameter("share", "1", 0.0, 1.0, 0.0, (0.5,), about="share of torque through the spring")),
            _partly,
            True,
            grows=True,
            restarts=_RESTARTS,
        ),
        Form(
            "inertia",
            "filter",
            "y - share·z''/ω², z as in series: the load cell also carries the mass",
            (
                *_RESONANCE,
                Parameter("share", "1", 0.0, 1.5, 0.0, (0.5,), about="share of the mass that the load cell carries"),
            ),
            _inertia,
            True,
            grows=True,
        ),
        Form(
            "toe",
            "filter",
            "q'' + 2 ζ ω q' + ω² (z - y) = 0, z = q (1 + stiffening·q²/y_max²)",
            (*_RESONANCE, _STIFFENING),
            _curved(toe=True),
            True,
            source="toe region of a tendon: Zajac 1989; Duffing's spring",
        ),
        Form(
            "stiffening",
            "filter",
            "z'' + 2 ζ ω z' + ω² (1 + stiffening·|z|/y_max) (z - y) = 0",
            (*_RESONANCE, replace(_STIFFENING, lower=-0.6)),
            _curved(toe=False),
            True,
            grows=True,
        ),
    ),
    signature="The torque oscillates after every step.",
    resembles=("electromechanical_delay",),
    separated_by="Steps, at a high sampling rate.",
    plain="Strap, tendon or fixture act as a spring: the torque oscillates after every step. Fasten the limb and the "
    "load cell more firmly.",
    source="A resonance in series with the muscle",
)
