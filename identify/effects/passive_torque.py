"""Passive torque of the joint: present without stimulation, depends on angle and velocity."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene

_VISCOUS = Parameter(
    "viscosity_nm_s_per_rad", "N·m·s/rad", -0.6, 0.6, 0.0, (0.0,), relative="torque", about="viscous part"
)


def _speed(scene: Scene) -> np.ndarray:
    return np.zeros_like(scene.time_s) if scene.velocity_rad_s is None else scene.velocity_rad_s


def _linear(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    assert scene.angle_rad is not None
    away = scene.angle_rad - scene.angle_rad[0]
    return p["stiffness_nm_per_rad"] * away + p["viscosity_nm_s_per_rad"] * _speed(scene)


def _exponential(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    assert scene.angle_rad is not None
    away = scene.angle_rad - scene.angle_rad[0]
    k = p["steepness_per_rad"]
    elastic = p["stiffness_nm_per_rad"] * np.expm1(np.clip(k * away, -30.0, 8.0)) / k
    return elastic + p["viscosity_nm_s_per_rad"] * _speed(scene)


def _two_sided(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
    assert scene.angle_rad is not None
    away = scene.angle_rad - scene.angle_rad[0]
    return (
        p["stiffness_nm_per_rad"] * away
        + p["bend_nm_per_rad2"] * away**2
        + p["hardening_nm_per_rad3"] * away**3
        + p["viscosity_nm_s_per_rad"] * _speed(scene)
    )


_STIFF = Parameter(
    "stiffness_nm_per_rad",
    "N·m/rad",
    -3.0,
    3.0,
    0.0,
    (0.0, 0.15),
    "linear",
    "torque",
    "elastic part, at the angle of the start",
)

EFFECT = Effect(
    id="passive_torque",
    name="Passive torque of the joint",
    forms=(
        Form(
            "linear",
            "additive",
            "y + stiffness·Δ + viscosity·velocity, Δ = angle - angle at the start",
            (_STIFF, _VISCOUS),
            _linear,
            True,
        ),
        Form(
            "exponential",
            "additive",
            "y + stiffness (exp(k·Δ) - 1)/k + viscosity·velocity",
            (_STIFF, Parameter("steepness_per_rad", "1/rad", 0.3, 10.0, 2.0, (2.0,), "log", about="k"), _VISCOUS),
            _exponential,
            True,
            source="(exp(4(l - 1)/0.6) - 1)/(e⁴ - 1), De Groote et al. 2016, and viscous",
        ),
        Form(
            "two_sided",
            "additive",
            "y + stiffness·Δ + bend·Δ² + hardening·Δ³ + viscosity·velocity",
            (
                _STIFF,
                Parameter("bend_nm_per_rad2", "N·m/rad²", -3.0, 3.0, 0.0, (0.0,), "linear", "torque", "one-sided part"),
                Parameter(
                    "hardening_nm_per_rad3",
                    "N·m/rad³",
                    -4.5,
                    4.5,
                    0.0,
                    (0.0,),
                    "linear",
                    "torque",
                    "stiffening at both ends",
                ),
                _VISCOUS,
            ),
            _two_sided,
            True,
        ),
    ),
    signature="Torque that follows the movement, also without stimulation.",
    resembles=("baseline_drift", "torque_velocity"),
    separated_by="Passive movement without stimulation.",
    plain="The joint resists movement also without stimulation: stiffness and, after a stroke, spasticity.",
    source="De Groote et al. 2016; Riener et al. 1996",
    needs=("angle_rad",),
)
