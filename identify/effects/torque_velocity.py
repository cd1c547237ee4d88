"""Dependence of the active torque on the joint's velocity."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_SIDE = Parameter("slope_s_per_rad", "s/rad", -2.0, 2.0, 0.0, (0.1, -0.1), about="share of torque lost per rad/s")
_SHAPE = Parameter("shape", "1", 0.1, 2.0, 0.25, (0.25,), "log", about="Hill's a/F0")
_TOP = Parameter("top", "1", 1.05, 1.9, 1.4, (1.4,), about="largest torque when lengthening, divided by isometric")


def _hyperbola(y: np.ndarray, p: Values, v: np.ndarray) -> np.ndarray:
    """Hill's hyperbola for shortening, continued to a plateau for lengthening."""
    shape = p["shape"]
    shortening = np.maximum(1.0 - v, 0.0) / (1.0 + np.maximum(v, 0.0) / shape)
    top = p["top"]
    lengthening = 1.0 + (top - 1.0) * -v / (-v + (top - 1.0) / (1.0 + 1.0 / shape) + 1e-12)
    return y * np.where(v >= 0, shortening, lengthening)


@form(
    "output",
    "y (1 - v)/(1 + v/shape) for shortening, up to `top`·y for lengthening; v = slope·velocity",
    _SIDE,
    _SHAPE,
    _TOP,
    source="Hill 1938; Thelen 2003",
    scales=True,
)
def hill(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _hyperbola(y, p, p["slope_s_per_rad"] * scene.speed)


@form(
    "output",
    "as hill, v = (slope + tilt·x + bow·x²)·velocity, x: place in the fitted range, -1 to 1",
    _SIDE,
    Parameter("tilt_s_per_rad", "s/rad", -1.0, 1.0, 0.0, (0.0,), about="slope's slope over the range"),
    Parameter("bow_s_per_rad", "s/rad", -1.0, 1.0, 0.0, (0.0,), about="slope's curvature over the range"),
    _SHAPE,
    _TOP,
    source="Hill 1938; Thelen 2003; Marion et al. 2010 for the dependence on the angle",
    scales=True,
)
def surface(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """As `hill`, its slope another one at each angle: moment arm and fibre length change with it."""
    slope = p["slope_s_per_rad"] + p["tilt_s_per_rad"] * scene.place + p["bow_s_per_rad"] * scene.place**2
    return _hyperbola(y, p, slope * scene.speed)


@form(
    "output",
    "y (1 - slope·x exp(1 - x)·θ'), x = decay·θ",
    _SIDE,
    Parameter("decay_per_rad", "1/rad", 0.3, 4.0, 1.3, (1.3,), "log", about="V2"),
    source="Marion, Wexler, Hull: V1 θ exp(-V2 θ) θ', as a share of the torque",
    scales=True,
)
def bell(y: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """The slope is the largest one over all angles."""
    place = p["decay_per_rad"] * np.abs(scene.angle)
    share = p["slope_s_per_rad"] * place * np.exp(1.0 - place) * scene.speed
    return y * np.maximum(1.0 - share, 0.0)


EFFECT = Effect(
    id="torque_velocity",
    name="Torque depends on velocity",
    forms=(hill, surface, bell),
    signature="The error follows the measured velocity, but only under stimulation.",
    resembles=("torque_angle", "passive_torque"),
    separated_by="The same movement with stimulation and without.",
    plain="A muscle that shortens quickly gives less torque; one that is stretched gives more. It does not matter "
    "while the limb is held still.",
    source="Hill 1938; Marion et al. 2010; De Groote et al. 2016",
    needs=("angle_rad", "velocity_rad_s"),
    main={"slope_s_per_rad": "slope"},
)
