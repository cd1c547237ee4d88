"""From a torque that a controller wants of a joint to the pulse widths of each channel, and how much both muscles pull.

Two muscles can give one torque in many ways, so co-contraction is stated, not found. It is written as a floor below
which no muscle may go; what is wanted beyond the floors is given by the muscles of one sign alone. Each
muscle's part is inverted as if it were alone; then what is asked for is corrected on the prediction of the whole model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from stimrig.identify import inversion as alone
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.inversion.demand import best_demand
from stimrig.identify.inversion.plant import Plant
from stimrig.identify.inversion.reference import Reference
from stimrig.identify.json_text import json_value
from stimrig.identify.muscles.model import JointModel, whole_and_parts
from stimrig.identify.muscles.record import JointRecord
from stimrig.identify.records.record import Record
from stimrig.identify.results import Result
from stimrig.identify.simulation.joint_surface import Surfaces
from stimrig.identify.simulation.pulses import REST_S, SAMPLES_A_PULSE
from stimrig.identify.summary import Sheet, quantity

CO_CONTRACTIONS = ("none", "constant", "stiffness")
LARGEST_LEVEL = 0.5
SMOOTH = 0.02
"""Torque around 0, as a share of the weaker side's largest, in which one side hands over to the other smoothly."""
ACTIVE = 0.01
"""The joint is active from where the reference first exceeds this share of the weaker side's largest, to the last."""
FADE_S = 0.5
"""In which co-contraction comes before that, but not before the first pulse, and goes after it."""
NEAR_ZERO = 0.15
"""Bound of `stiffness` where none is given, as a share of the weaker side's largest torque."""


@dataclass(frozen=True)
class Limits:
    """Of one channel; as of one muscle's `invert`."""

    largest_us: float | None = None  # widest pulse
    rise_us: float | None = None  # largest rise from pulse to pulse
    shortest_us: float = 0.0  # narrowest pulse
    dose_us: float = np.inf  # largest sum of its widths, its charge over its current; the demand is scaled down to it


@dataclass(frozen=True, repr=False, eq=False)
class JointInversion(Result):
    """Pulse widths of each channel for a torque of the joint; arrays of shape (K,)."""

    reference: Reference  # what was asked for
    co_contraction: str  # one of `CO_CONTRACTIONS`
    level: float  # of each muscle's largest torque, that is kept
    bound_nm: float  # torque of either sign up to which `stiffness` keeps it
    pulse_width_us: dict[str, np.ndarray]  # by channel
    predicted_nm: np.ndarray  # of the joint above rest, mean in each pulse's period
    muscle_nm: dict[str, np.ndarray]  # of each muscle by itself, before the joint takes what co-contraction costs
    unreachable: tuple[alone.Stretch, ...]  # where it is not reached, in order of time
    fit_percent: float | None  # best fit where it can be reached; None if the reference does not change there
    whole_fit_percent: float | None  # of all of it
    tolerance_nm: float  # a smaller difference counts as reached

    def _sheet(self) -> Sheet:
        fit = f"fit {quantity(self.fit_percent, '%')} where it can be reached"
        rows = [(name, f"up to {quantity(own.max(), 'µs')}") for name, own in self.pulse_width_us.items()]
        rows += [one.row() for one in self.unreachable[:8]]
        return Sheet(f"Pulse widths of {len(self.pulse_width_us)} channels for a torque: {fit}", tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """As JSON.

        Returns
        -------
        dict
        """
        reference = self.reference
        apart = ("reference", "predicted_nm", "muscle_nm", "unreachable")
        told = {name: value for name, value in vars(self).items() if name not in apart}
        told |= {"pulse_rate_hz": reference.pulse_rate_hz, "reference_torque_nm": reference.torque_nm.round(6)}
        told |= {"duration_s": reference.torque_nm.size / reference.pulse_rate_hz}
        told |= {"predicted_torque_nm": self.predicted_nm.round(6), "muscle_torque_nm": self.muscle_nm}
        return json_value(told | {"unreachable": [one.to_dict() for one in self.unreachable]})


def invert(
    model: JointModel,
    torque_nm: Reference | Any,
    *,
    co_contraction: str = "none",
    level: float = 0.1,
    bound_nm: float | None = None,
    limits: Limits | Mapping[str, Limits] = Limits(),
    whole: bool = True,
) -> JointInversion:
    """The pulse widths of each channel whose predicted torque follows a reference best.

    Parameters
    ----------
    model : JointModel
        At a joint that does not move.
    torque_nm : Reference or array_like, shape (K,)
        Torque of the joint above rest, one for each pulse period, N·m.
    co_contraction : str
        "none": each torque by the muscles of one sign, with a smooth change at 0. "constant": while the joint is
        active every muscle keeps `level` of its largest torque. "stiffness": the same, but only where the torque is
        below `bound_nm`, by default 15 % of the weaker side's largest, and gone at twice that. It is the muscles'
        activity that is kept: how stiff the joint is then, no torque of a joint at rest tells.
    level : float
        0 to 0.5.
    limits : Limits or mapping
        Of each channel, or by channel; one that is not named has none.
    whole : bool
        Whole µs.
    bound_nm : float, optional
        Torque up to which "stiffness" keeps both muscles active, N·m.

    Returns
    -------
    JointInversion

    Raises
    ------
    BadModel
        As of one muscle's `invert`; it depends on the joint's angle.
    BadRequest
        A number that is none, a limit that is not positive, an unknown channel or choice, no antagonist to contract.
    """
    if not isinstance(torque_nm, Reference):
        torque_nm = Reference.of(torque_nm, pulse_rate_hz=model.pulse_rate_hz)
    joint = _Joint(model, torque_nm, limits, whole)
    bound_nm = NEAR_ZERO * joint.weaker_nm if bound_nm is None else bound_nm
    _refuse(joint, co_contraction, level, bound_nm)
    wanted = torque_nm.torque_nm
    kept = {"none": 0.0, "constant": 1.0, "stiffness": _fading(np.abs(wanted) / bound_nm - 1.0)}[co_contraction]
    floors = level * joint.largest_nm[:, None] * (kept * joint.active)
    asked, lower, best, least, idle = wanted, floors, None, np.inf, 0
    demands = np.zeros(floors.shape)
    for _ in range(alone.TURNS):
        demands = joint.demands(joint.split(asked, lower), demands)
        widths, bounded = joint.widths(demands)
        got, own = joint.torque(widths)
        error, lacking = wanted - got, np.maximum(floors - joint.signs[:, None] * own, 0.0)
        left = float(np.sqrt(np.mean(error**2) + np.mean(lacking**2)))
        idle = idle + 1 if left > alone.GAIN * least else 0
        if left < least:
            best, least = (demands, widths, bounded, got, own), left
        if idle > 1 or left < alone.ENOUGH * joint.weaker_nm:
            break
        asked = np.clip(asked + alone.STEP * error, -joint.strength(-1.0), joint.strength(1.0))
        lower = np.minimum(lower + alone.STEP * lacking, joint.largest_nm[:, None])
    assert best is not None
    return _judged(joint, torque_nm, best, {"co_contraction": co_contraction, "level": level, "bound_nm": bound_nm})


def _refuse(joint: _Joint, co_contraction: str, level: float, bound_nm: float) -> None:
    one_way = co_contraction != "none" and np.ptp(joint.signs) == 0.0
    for right, said, place, fix in (
        (
            co_contraction in CO_CONTRACTIONS,
            f"unknown {co_contraction!r}",
            "co_contraction",
            ", ".join(CO_CONTRACTIONS),
        ),
        (not one_way, "all muscles of the model pull in one direction", "co_contraction", "none: no antagonist"),
        (0.0 <= level <= LARGEST_LEVEL, f"{level:g} of the largest torque", "level", f"0 to {LARGEST_LEVEL:g}"),
        (0.0 < bound_nm < np.inf, f"{bound_nm:g} N·m", "bound_nm", "a positive number, or none"),
    ):
        if not right:
            raise BadRequest(said, place=place, fix=f"Give {fix}.")


class _Joint:
    """All muscles as the inversion sees them, and the model's prediction for them."""

    def __init__(
        self, model: JointModel, reference: Reference, limits: Limits | Mapping[str, Limits], whole: bool
    ) -> None:
        if any(Surfaces.of(one.effects) is not None for one in model.models):
            fix = "Fit it on a record of a joint that is held."
            raise BadModel("the model depends on the angle of the joint", place="effects", fix=fix)
        first_s = min(channel.offset_s for channel in model.channels)  # periods begin with the train
        self.channels = tuple(replace(one, offset_s=one.offset_s - first_s) for one in model.channels)
        self.model, self.rate_hz = model, reference.pulse_rate_hz
        given = dict.fromkeys(model.names, limits) if isinstance(limits, Limits) else limits
        for name in given:
            model.of(name)
        own = [given.get(name, Limits()) for name in model.names]
        self.doses_us = [one.dose_us for one in own]
        if not all(dose_us > 0.0 for dose_us in self.doses_us):
            raise BadRequest("no positive number", place="dose_us", fix="Give one, or leave it out.")
        self.plants: list[Plant] = []
        for channel, one, limit in zip(self.channels, model.models, own, strict=True):
            assert isinstance(one.linear, SecondOrder)  # JointModel.check
            late = one.with_(linear=replace(one.linear, delay_s=one.linear.delay_s + channel.offset_s))
            most = limit.largest_us, limit.rise_us
            self.plants.append(Plant.of(late, reference, *most, whole, limit.shortest_us))
        self.signs = np.array([plant.sign for plant in self.plants])
        self.largest_nm = np.array([plant.largest_nm for plant in self.plants])
        self.shares = self.largest_nm / np.array([self.strength(sign) for sign in self.signs])
        self.weaker_nm = min(self.strength(sign) for sign in self.signs)
        k, at = (
            np.arange(reference.torque_nm.size),
            np.flatnonzero(np.abs(reference.torque_nm) > ACTIVE * self.weaker_nm),
        )
        fade = FADE_S * self.rate_hz
        away = np.max([at[0] - k, k - at[-1], fade - k], axis=0) / fade if at.size else np.ones(k.size)
        self.active = _fading(away)  # 1 while the joint is active, 0 where it rests before and after

    def strength(self, sign: float) -> float:
        """The largest torque of all muscles of this sign, N·m, positive."""
        return float(self.largest_nm[self.signs == sign].sum())

    def split(self, torque_nm: np.ndarray, floors_nm: np.ndarray) -> np.ndarray:
        """Each muscle's part of a torque, at least its floor, N·m in its direction of pull, shape (C, K)."""
        beyond, width_nm = torque_nm - self.signs @ floors_nm, SMOOTH * self.weaker_nm
        own = self.signs[:, None] * beyond
        smooth = np.clip(own + width_nm, 0.0, 2.0 * width_nm) ** 2 / (4.0 * width_nm)
        near = (np.abs(own) < width_nm) & (self.active == 1.0) & (np.ptp(self.signs) > 0.0)
        return floors_nm + self.shares[:, None] * np.where(near, smooth, np.maximum(own, 0.0))

    def demands(self, parts_nm: np.ndarray, before_nm: np.ndarray) -> np.ndarray:
        """The demands that follow them best, shape (C, K); `before_nm`: those of the turn before."""
        told = zip(self.plants, parts_nm, before_nm, strict=True)
        return np.stack([best_demand(p.a, p.b, part, p.largest_nm, p.rises(last)) for p, part, last in told])

    def widths(self, demands_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Within all limits of each channel, µs, shape (C, K), and which channels their dose bounds, (C,)."""
        told = [self._dosed(*one) for one in zip(self.plants, self.doses_us, demands_nm, strict=True)]
        return np.stack([widths for widths, _ in told]), np.array([bounded for _, bounded in told])

    @staticmethod
    def _dosed(plant: Plant, dose_us: float, demand_nm: np.ndarray) -> tuple[np.ndarray, bool]:
        widths, share = plant.widths(demand_nm), 0.0
        if widths.sum() <= dose_us:
            return widths, False
        for step in 0.5 ** np.arange(1, 13):
            share += step * (plant.widths((share + step) * demand_nm).sum() <= dose_us)
        return plant.widths(share * demand_nm), True

    def torque(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the model predicts above rest: of the joint, shape (K,), and of each muscle, (C, K), N·m."""
        whole_nm, own_nm = self._predicted(widths_us)
        return whole_nm - self._at_rest[0], own_nm - self._at_rest[1]

    @cached_property
    def _at_rest(self) -> tuple[np.ndarray, np.ndarray]:
        return self._predicted(np.zeros((len(self.plants), self.active.size)))

    def _predicted(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means in each pulse's period, after a rest."""
        rest, each = round(REST_S * self.rate_hz), SAMPLES_A_PULSE
        held = np.repeat(np.pad(widths_us, ((0, 0), (rest, 0))), each, axis=1)
        time_s, nothing = np.arange(held.shape[1]) / (each * self.rate_hz), np.zeros(held.shape[1])
        records = [Record.from_arrays(time_s, own, nothing, pulse_rate_hz=self.rate_hz) for own in held]
        whole_nm, own_nm = whole_and_parts(self.model, JointRecord(self.channels, tuple(records)))
        means = np.stack([whole_nm, *own_nm.values()]).reshape(len(own_nm) + 1, -1, each).mean(axis=2)[:, rest:]
        return means[0], means[1:]


def _fading(away: np.ndarray) -> np.ndarray:
    """1 at 0 and below, 0 from 1 on, smooth in between."""
    left = 1.0 - np.clip(away, 0.0, 1.0)
    return left**2 * (3.0 - 2.0 * left)


def _judged(
    joint: _Joint, reference: Reference, found: tuple[np.ndarray, ...], stated: dict[str, Any]
) -> JointInversion:
    demands, widths, bounded, got, own = found
    wanted, tolerance_nm = reference.torque_nm, alone.TOLERANCE * joint.weaker_nm
    error_nm = np.abs(wanted - got)
    missed = error_nm > tolerance_nm
    reasons = np.full(wanted.size, -1)
    for sign in sorted(set(joint.signs.tolist())):  # the strongest muscle of each side speaks for it
        place = int(np.argmax(np.where(joint.signs == sign, joint.largest_nm, -1.0)))
        share, plant = joint.shares[place], joint.plants[place]
        pull, short = sign * wanted, sign * wanted > sign * got
        told = alone.reasons_of(plant, share * pull, demands[place], missed, short, share * tolerance_nm)
        if bounded[joint.signs == sign].any():
            told[missed & short] = alone.REASONS.index("beyond-dose")
        side = (pull >= 0.0) | (np.ptp(joint.signs) == 0.0)
        reasons[side] = told[side]
    return JointInversion(
        reference=reference,
        **stated,
        pulse_width_us=dict(zip(joint.model.names, widths, strict=True)),
        predicted_nm=got,
        muscle_nm=dict(zip(joint.model.names, own, strict=True)),
        unreachable=alone.stretches_of(reasons, error_nm, reference.pulse_rate_hz),
        fit_percent=alone.best_fit(wanted[~missed], got[~missed]),
        whole_fit_percent=alone.best_fit(wanted, got),
        tolerance_nm=tolerance_nm,
    )
