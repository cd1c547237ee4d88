"""g(x, ẋ) and h(x, ẋ) of a model, the rest of Fig. 2 of the paper, as tables with bands.

T = baseline + g(x, ẋ)·y + h(x, ẋ) + inertia·ẍ, y = G f(u) at the reference angle. g is the product of what the model's
effects multiply the torque by, h the sum of what they add to it; whatever form each of them has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stimrig.identify.effects import find_effect
from stimrig.identify.effects.base import Effect, Form, Scene
from stimrig.identify.errors import BadModel
from stimrig.identify.model_schema import FIX, parameter_value

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
            form = effect.form(entry["form"])
            values = {p.name: float(parameter_value(entry["parameters"][p.name])) for p in form.parameters}
        except Exception as error:
            raise BadModel(f"{error}", place=f"effects.{entry.get('id')}", fix="Install the effect's file.") from error
        return cls(effect, form, values)

    @property
    def adds(self) -> bool:
        return self.form.stage == "additive"

    def apply(self, x: np.ndarray | None, scene: Scene) -> np.ndarray:
        """The form with its values, shape (1, K)."""
        return np.asarray(self.form.call(x, {name: np.array([[v]]) for name, v in self.values.items()}, scene))


@dataclass(frozen=True)
class Surfaces:
    """g and h of a model, to be asked at any angles and velocities."""

    acting: tuple[JointEffect, ...]  # the model's effects that depend on the joint
    settings: Mapping[str, Any]  # those that the effects were fitted with

    @classmethod
    def of(cls, effects: Sequence[Mapping[str, Any]]) -> Surfaces | None:
        """Those of a model's effects; None if none of them depends on the joint.

        Raises BadModel: an effect or its form is unknown here, or the model does not say at which angles it holds.
        """
        acting = [joint_effect for joint_effect in map(JointEffect.of, effects) if joint_effect.effect.moves_with_joint]
        if not acting:
            return None
        settings = effects[0]["settings"]
        for key in ("angle_range_rad", "reference_rad"):
            if key not in settings:
                raise BadModel("the key is missing", place=f"effects.0.settings.{key}", fix=FIX)
        return cls(tuple(acting), settings)

    @property
    def reference_rad(self) -> float:
        """The angle at which f holds as it stands, rad."""
        return float(self.settings["reference_rad"])

    @property
    def inertia_nm_s2_per_rad(self) -> float:
        """Torque at the load cell per acceleration, N·m per rad/s², with the record's sign."""
        return self._sign * sum(joint_effect.values.get(INERTIA, 0.0) for joint_effect in self.acting)

    @property
    def _sign(self) -> float:
        return float(self.settings["sign"])

    def g(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> np.ndarray:
        """Share of the torque at the reference angle that is there, at rest 1 at that angle; of the inputs' shape."""
        scene = self._scene(angle_rad, velocity_rad_s)
        torque = large = np.full((1, scene.time_s.size), scene.scale_nm)
        for joint_effect in self.acting:
            if not joint_effect.adds:
                torque = joint_effect.apply(torque, scene)
        return (torque / large).reshape(np.shape(angle_rad))

    def h_nm(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> np.ndarray:
        """Passive torque, 0 at rest at the reference angle, with the record's sign, N·m; of the inputs' shape.

        Of tissue that has been there for long: what of it relaxes is not in it.
        """
        scene = self._scene(angle_rad, velocity_rad_s)
        added = (joint_effect.apply(None, scene) for joint_effect in self.acting if joint_effect.adds)
        return self._sign * sum(added, np.zeros((1, scene.time_s.size))).reshape(np.shape(angle_rad))

    def _scene(self, angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> Scene:
        angle, velocity = (np.ravel(np.asarray(values, float)) for values in (angle_rad, velocity_rad_s))
        return Scene(
            time_s=np.zeros(angle.size),
            pulse_width_us=np.zeros(angle.size),
            step_s=1.0,
            scale_nm=float(self.settings["scale_nm"]),
            largest_us=1.0,
            angle_rad=angle,
            velocity_rad_s=velocity,
            reference_rad=self.reference_rad,
            angle_range_rad=self.settings["angle_range_rad"],
            begins=np.ones(angle.size, bool),
        )

    def slopes(self, names: Sequence[str], angle_rad: np.ndarray, velocity_rad_s: np.ndarray) -> np.ndarray:
        """Derivatives of g and of h by named parameters of the model, shape (2, len(names), *inputs' shape)."""
        at, derivatives = (angle_rad, velocity_rad_s), np.zeros((2, len(names), *np.shape(angle_rad)))
        places = {name: place for place, name in enumerate(names)}
        for number, moved in enumerate(self.acting):
            for name, value in moved.values.items():
                place = places.get(f"{moved.effect.id}.{name}")
                if place is None:
                    continue
                step = STEP * max(abs(value), 0.01)
                for sign in (1.0, -1.0):
                    other = replace(moved, values=moved.values | {name: value + sign * step})
                    surfaces = Surfaces((*self.acting[:number], other, *self.acting[number + 1 :]), self.settings)
                    derivatives[:, place] += sign * np.stack([surfaces.g(*at), surfaces.h_nm(*at)]) / (2 * step)
        return derivatives


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
    low, high = surfaces.settings["angle_range_rad"]
    angles = np.unique(np.r_[np.linspace(low, high, ANGLES), np.clip(surfaces.reference_rad, low, high)])
    shares = np.array(SPEEDS)
    velocities = max(float(np.max(np.abs(velocity_rad_s))), 1e-3) * np.r_[-shares[:0:-1], shares]
    x, v = np.meshgrid(angles, velocities, indexing="ij")
    edges = [np.r_[-np.inf, 0.5 * (axis[1:] + axis[:-1]), np.inf] for axis in (angles, velocities)]

    def nearest(rows: np.ndarray | slice) -> np.ndarray:
        return np.histogram2d(angle_rad[rows], velocity_rad_s[rows], bins=edges)[0].astype(int)

    tables: dict[str, Any] = {
        "reference_angle_rad": surfaces.reference_rad,
        "angle_rad": angles,
        "velocity_rad_s": velocities,
        "inertia_nm_s2_per_rad": surfaces.inertia_nm_s2_per_rad,
        "formula": {
            "torque": FORMULA,
            "g": [joint_effect.form.equation for joint_effect in surfaces.acting if not joint_effect.adds],
            "h": [joint_effect.form.equation for joint_effect in surfaces.acting if joint_effect.adds],
        },
        "seen_g": nearest(at_work),
        "seen_h": nearest(slice(None)),
        "level_percent": 95,
    }
    rows = [place for place, name in enumerate(names) if "." in name]
    slopes = surfaces.slopes([names[row] for row in rows], x, v)
    values = surfaces.g(x, v).round(6), surfaces.h_nm(x, v).round(6)
    for name, unit, value, slope in zip("gh", ("", "_nm"), values, slopes, strict=True):
        variance = np.einsum("iab,ij,jab->ab", slope, matrix[np.ix_(rows, rows)], slope, optimize=True)
        half = WIDER[name] * POINTWISE * np.sqrt(np.maximum(variance, 0.0))
        bounds = {"lower": (value - half).round(6), "upper": (value + half).round(6)}
        tables |= {f"{name}{unit}": value} | {f"{name}_{side}{unit}": bound for side, bound in bounds.items()}
    return tables
