"""g(x, ẋ) and h(x, ẋ) of a model, the rest of Fig. 2 of the paper, as tables with bands.

T = baseline + g(x, ẋ)·y + h(x, ẋ) + inertia·ẍ, y = G f(u) at the reference angle. g is the product of what the model's
effects multiply the torque by, h the sum of what they add to it; whatever form each of them has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from stimrig.identify.effects import find_effect
from stimrig.identify.effects.base import Effect, Form, Scene
from stimrig.identify.errors import BadModel
from stimrig.identify.model_schema import parameter_value

ANGLES = 61
SPEEDS = (0.0, 0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 0.75, 1.0)
"""Velocities of the table, as shares of the largest one: closer together near 0, where dry friction turns."""
POINTWISE = 1.959964
WIDER = {"g": 1.15, "h": 1.4}
"""Factor on the bands: with it they hold 95 % of the seen cells of arms 0 to 59, on which it was developed. Encoder and
differentiation bend the angles a little, which no covariance of the parameters knows."""
INERTIA = "inertia_nm_s2_per_rad"
STEP = 1e-4
FORMULA = "T = baseline + g(x, v) y + h(x, v) + inertia a; y = G f(u); x: angle, v: velocity, a: acceleration"


@dataclass(frozen=True)
class JointEffect:
    """One effect of a model, with its values."""

    effect: Effect
    form: Form
    values: dict[str, float]

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> JointEffect:
        """From its row in MODEL.json.

        Raises BadModel: the effect or its form is unknown here, or a parameter is missing.
        """
        try:
            effect = find_effect(entry["id"])
            form = effect.form(entry.get("form", ""))
            values = {p.name: float(parameter_value(entry["parameters"][p.name])) for p in form.parameters}
        except Exception as error:
            raise BadModel(f"{error}", place=f"effects.{entry.get('id')}", fix="Install the effect's file.") from error
        return cls(effect, form, values)

    @property
    def adds(self) -> bool:
        return self.form.stage == "additive"


@dataclass(frozen=True)
class Surfaces:
    """g and h of a model, to be asked at any angles and velocities."""

    acting: tuple[JointEffect, ...]  # the model's effects that depend on the joint
    settings: Mapping[str, Any]  # those that the effects were fitted with

    @classmethod
    def of(cls, effects: Sequence[Mapping[str, Any]]) -> Surfaces | None:
        """Those of a model's effects; None if none of them depends on the joint.

        Raises BadModel: an effect or its form is unknown here, or the model does not say its reference angle.
        """
        acting = [joint_effect for joint_effect in map(JointEffect.of, effects) if joint_effect.effect.moves_with_joint]
        if not acting:
            return None
        settings = effects[0].get("settings", {})
        if "reference_rad" not in settings:
            raise BadModel("the model does not say at which angle its curve holds", fix="Fit its record again.")
        return cls(tuple(acting), settings)

    @property
    def reference_rad(self) -> float:
        """The angle at which f holds as it stands, rad."""
        return float(self.settings["reference_rad"])

    @property
    def inertia_nm_s2_per_rad(self) -> float:
        """Torque at the load cell per acceleration, N·m per rad/s², with the record's sign."""
        return self._sign * sum(joint_effect.values.get(INERTIA, 0.0) for joint_effect in self.acting)

    @cached_property
    def _sign(self) -> float:
        return float(self.settings.get("sign", 1.0))

    def g(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> np.ndarray:
        """Share of the torque at the reference angle that is there, at rest 1 at that angle; of the inputs' shape."""
        scene = self._scene(angle_rad, velocity_rad_s)
        large = np.full((1, scene.time_s.size), float(self.settings.get("scale_nm", 1.0)))
        torque = large
        for joint_effect in self.acting:
            if not joint_effect.adds:
                torque = np.asarray(joint_effect.form.call(torque, _rows(joint_effect.values), scene))
        return (torque / large).reshape(np.shape(angle_rad))

    def h_nm(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> np.ndarray:
        """Passive torque, 0 at rest at the reference angle, with the record's sign, N·m; of the inputs' shape.

        Of tissue that has been there for long: what of it relaxes is not in it.
        """
        scene = self._scene(angle_rad, velocity_rad_s)
        total = np.zeros((1, scene.time_s.size))
        for joint_effect in self.acting:
            if joint_effect.adds:
                total = total + np.asarray(joint_effect.form.call(None, _rows(joint_effect.values), scene))
        return self._sign * total.reshape(np.shape(angle_rad))

    def _scene(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> Scene:
        angle, velocity = (np.ravel(np.asarray(values, float)) for values in (angle_rad, velocity_rad_s))
        return Scene(
            time_s=np.zeros(angle.size),
            pulse_width_us=np.zeros(angle.size),
            step_s=1.0,
            scale_nm=float(self.settings.get("scale_nm", 1.0)),
            largest_us=1.0,
            angle_rad=angle,
            velocity_rad_s=velocity,
            reference_rad=self.reference_rad,
            angle_range_rad=angle_range(self.settings),
            begins=np.ones(angle.size, bool),
        )

    def _with(self, name: str, value: float) -> Surfaces:
        """With one parameter, by its name in the covariance, changed."""
        effect, _, parameter = name.partition(".")
        acting = [
            replace(joint_effect, values=joint_effect.values | {parameter: value})
            if joint_effect.effect.id == effect
            else joint_effect
            for joint_effect in self.acting
        ]
        return Surfaces(tuple(acting), self.settings)

    def slopes(
        self, names: Sequence[str], angle_rad: np.ndarray, velocity_rad_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of g and of h by named parameters of the model, each of shape (len(names), *inputs' shape)."""
        values = {
            f"{joint_effect.effect.id}.{name}": value
            for joint_effect in self.acting
            for name, value in joint_effect.values.items()
        }
        derivatives = np.zeros((2, len(names), *np.shape(angle_rad)))
        for place, name in enumerate(names):
            if name not in values:
                continue
            step = STEP * max(abs(values[name]), 0.01)
            up, down = self._with(name, values[name] + step), self._with(name, values[name] - step)
            derivatives[0, place] = (up.g(angle_rad, velocity_rad_s) - down.g(angle_rad, velocity_rad_s)) / (2 * step)
            derivatives[1, place] = (up.h_nm(angle_rad, velocity_rad_s) - down.h_nm(angle_rad, velocity_rad_s)) / (
                2 * step
            )
        return derivatives[0], derivatives[1]


def joint_tables(
    effects: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    matrix: np.ndarray,
    angle_rad: np.ndarray,
    velocity_rad_s: np.ndarray,
    at_work: np.ndarray,
) -> dict[str, Any]:
    """Make the tables under `joint` in MODEL.json: g and h on a grid, 95 % bands, and intervals in each cell.

    `names`, `matrix`: of the model's parameters and their covariance. `angle_rad`, `velocity_rad_s`: of each fitted
    pulse interval. `at_work`: those in which the muscle was stimulated: only they show g.

    Empty if nothing of the model depends on the joint. Tables have one row for each angle and one column for each
    velocity; `seen_g` and `seen_h` count the pulse intervals nearest to each.
    """
    surfaces = Surfaces.of(effects)
    if surfaces is None:
        return {}
    low, high = surfaces.settings.get("angle_range_rad", (float(angle_rad.min()), float(angle_rad.max())))
    angles = np.unique(np.r_[np.linspace(low, high, ANGLES), np.clip(surfaces.reference_rad, low, high)])
    fastest = max(float(np.max(np.abs(velocity_rad_s))), 1e-3)
    shares = np.array(SPEEDS)
    velocities = fastest * np.r_[-shares[:0:-1], shares]
    x, v = np.meshgrid(angles, velocities, indexing="ij")
    tables = {
        "reference_angle_rad": surfaces.reference_rad,
        "angle_rad": angles,
        "velocity_rad_s": velocities,
        "g": surfaces.g(x, v).round(6),
        "h_nm": surfaces.h_nm(x, v).round(6),
        "inertia_nm_s2_per_rad": surfaces.inertia_nm_s2_per_rad,
        "formula": {
            "torque": FORMULA,
            "g": [joint_effect.form.equation for joint_effect in surfaces.acting if not joint_effect.adds],
            "h": [joint_effect.form.equation for joint_effect in surfaces.acting if joint_effect.adds],
        },
        "seen_g": _cell_counts(angles, velocities, angle_rad[at_work], velocity_rad_s[at_work]),
        "seen_h": _cell_counts(angles, velocities, angle_rad, velocity_rad_s),
    }
    return tables | _bands(surfaces, names, matrix, x, v, tables["g"], tables["h_nm"])


def _bands(
    surfaces: Surfaces, names: Sequence[str], matrix: np.ndarray, x: np.ndarray, v: np.ndarray, g: Any, h_nm: Any
) -> dict[str, Any]:
    rows = [place for place, name in enumerate(names) if "." in name]
    matrix = matrix[np.ix_(rows, rows)]
    slopes = surfaces.slopes([names[row] for row in rows], x, v)
    bands: dict[str, Any] = {"level_percent": 95}
    for name, unit, value, slope in (("g", "", g, slopes[0]), ("h", "_nm", h_nm, slopes[1])):
        variance = np.einsum("iab,ij,jab->ab", slope, matrix, slope, optimize=True)
        half = WIDER[name] * POINTWISE * np.sqrt(np.maximum(variance, 0.0))
        bands |= {f"{name}_lower{unit}": (value - half).round(6), f"{name}_upper{unit}": (value + half).round(6)}
    return bands


def _cell_counts(
    angles: np.ndarray, velocities: np.ndarray, angle_rad: np.ndarray, velocity_rad_s: np.ndarray
) -> np.ndarray:
    """Number of the given points nearest to each cell of the table, shape (len(angles), len(velocities))."""
    edges = [np.r_[-np.inf, 0.5 * (axis[1:] + axis[:-1]), np.inf] for axis in (angles, velocities)]
    return np.histogram2d(angle_rad, velocity_rad_s, bins=edges)[0].astype(int)


def angle_range(settings: Mapping[str, Any]) -> tuple[float, float] | None:
    """Smallest and largest angle that a model was fitted on, rad; None if it does not say."""
    known = settings.get("angle_range_rad")
    return None if known is None else (float(known[0]), float(known[1]))


def _rows(values: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {name: np.array([[value]]) for name, value in values.items()}
