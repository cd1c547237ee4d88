"""A muscle in an arm, drawn by a seed, whose truth is known: recruitment, dynamics, g(x, ẋ), h(x, ẋ), inertia.

    T = g(x, ẋ) · (G f(u)) + h(x, ẋ) − I ẍ

f and G are those of `hardware_sim.hidden.base`: eight shapes of recruitment, 3 to 15 N·m at 250 to 400 µs, 10
to 90 % within 26 to 150 µs; second order with 0.1 to 0.6 s and damping 0.6 to 1.2, two lags, or calcium then force. G
is linear. x = 90 degrees, ẋ = 0 is where g is 1.

How the rest is drawn (U: uniform, L: log-uniform; all independent):

- *Torque-angle*: product of moment arm and fibre force (0.35), fibre force alone (0.25), moment arm alone (0.25),
  parabola (0.15). Fibres: best at U(0.8, 2.1) rad, U(0.3, 0.7) lengths a rad, γ U(0.25, 0.5). Arm: largest at
  U(1.3, 2.0) rad, U(0.2, 0.6) of it left, U(0.8, 1.4) rad of the cosine a rad. Parabola: best U(60, 110) degrees,
  half of it left U(55, 100) degrees away. Drawn again until g lies between 0.15 and 2 over the range of the day at
  rest: a stimulated elbow has a sixth of its torque left at least.
- *Torque-velocity*: Hill (0.45) and De Groote's logarithm (0.25) with a largest velocity of L(6, 22) rad/s, curvature
  U(0.15, 0.6), plateau U(1.2, 1.8); Marion's bell (0.2) with L(0.03, 0.25) lost per rad/s, V2 U(0.012, 0.035) per
  degree; none (0.1).
- *Passive*: two exponentials (0.35) with U(2.5, 7) per rad, 1 N·m at U(0.1, 0.7) and U(1.9, 2.5) rad, a constant of
  U(-0.4, 0.4) N·m; fibres of De Groote (0.25), flexor L(1.5, 20) N·m slack at U(1.0, 1.8) rad, extensor L(1, 10) N·m
  slack at U(1.2, 2.0) rad, U(0.35, 0.7) lengths a rad; linear with dry friction (0.2), L(0.4, 5) N·m/rad about
  U(1.1, 1.8) rad and U(0, 0.4) N·m; standard linear solid (0.2), L(0.5, 6) N·m/rad, U(0.3, 0.8) of it lasting, relaxing
  within L(0.3, 3) s: then h has a memory and `h_nm` is that of tissue at rest. Viscosity L(0.02, 0.5) N·m·s.
- *Forearm*: inertia U(0.04, 0.11) kg·m²; a horizontal plane (0.6), or a vertical one with L(1.5, 4) N·m and the upper
  arm at U(0, 90) degrees: then gravity is part of h.
- *Range of the day*: from U(8, 45) to U(95, 138) degrees. The stops lie at -5 and 145.

Seeds 0 to 99 are for development; reported figures use seeds from 1000.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.signal import cont2discrete, lfilter

from stimrig.hardware_sim.arm.laws import LAWS, Floats, Number
from stimrig.hardware_sim.arm.tissue import REFERENCE_RAD, Mechanics, Tissue, law, law_name
from stimrig.hardware_sim.hidden.base import Base, draw_base
from stimrig.hardware_sim.hidden.scenario import rng_of

SMALLEST_G, LARGEST_G = 0.15, 2.0


@dataclass(frozen=True)
class ArmPatient:
    """A muscle at the reference angle, its arm, and the range that may be moved through that day."""

    seed: int
    base: Base
    tissue: Tissue
    range_rad: tuple[float, float]

    reference_rad = REFERENCE_RAD

    @property
    def largest_width_us(self) -> int:
        """The largest pulse width that is sent."""
        return self.base.largest_width_us

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia of the forearm and of what moves with it."""
        return self.tissue.mechanics.inertia_kg_m2

    def recruitment_nm(self, width_us: Number) -> Floats:
        """f(u): steady torque at the reference angle, N·m."""
        table = self.base.table_nm
        return np.interp(width_us, np.arange(table.size), table)

    def g(self, angle_rad: Number, velocity_rad_s: Number) -> Floats:
        """Factor on G f(u), 1 at the reference angle and at rest."""
        return np.asarray(self.tissue.g(np.asarray(angle_rad, float), np.asarray(velocity_rad_s, float)))

    def h_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Floats:
        """Passive torque with gravity, of a joint that has been there for long, N·m."""
        return np.asarray(self.tissue.h_nm(np.asarray(angle_rad, float), np.asarray(velocity_rad_s, float)))

    def isometric_nm(self, width_us: Floats, step_s: float) -> Floats:
        """G f(u) for widths held over each step, exact; the value at a step knows the widths before it."""
        period, damping = self.base.t_omega_s, self.base.zeta
        system: Any = cont2discrete(([1.0], [period**2, 2.0 * damping * period, 1.0]), step_s)
        return np.asarray(lfilter(np.ravel(system[0]), np.ravel(system[1]), self.recruitment_nm(width_us)))

    def remembered_nm(self, angle_rad: Floats, step_s: float) -> Floats:
        """Return the torque that the tissue's memory adds to `h_nm` along a movement, N·m."""
        passive = self.tissue.passive
        memory, out = passive.begin(float(angle_rad[0])), np.empty(angle_rad.size)
        for k, at_rad in enumerate(angle_rad.tolist()):
            memory = passive.step(memory, at_rad, step_s)
            out[k] = passive.remembered_nm(memory, at_rad)
        return out

    @cached_property
    def truth(self) -> dict[str, Any]:
        """The drawn parameters, as plain values."""
        laws = {place: getattr(self.tissue, place) for place in LAWS}
        return {
            "seed": self.seed,
            "muscle": self.base.describe(),
            "range_rad": list(self.range_rad),
            "mechanics": asdict(self.tissue.mechanics),
            **{place: {"law": law_name(place, each), **asdict(each)} for place, each in laws.items()},
        }


def arm_patient(seed: int) -> ArmPatient:
    """The arm that `seed` draws."""
    rng = rng_of(seed, "arm patient")
    base = draw_base(rng)
    range_rad = math.radians(rng.uniform(8.0, 45.0)), math.radians(rng.uniform(95.0, 138.0))
    passive, velocity, mechanics = _passive(rng), _torque_velocity(rng), _mechanics(rng)
    while True:
        tissue = Tissue(passive, _torque_angle(rng), velocity, mechanics)
        g = tissue.g(np.linspace(*range_rad, 50), 0.0)
        if g.min() >= SMALLEST_G and g.max() <= LARGEST_G:
            return ArmPatient(seed, base, tissue, range_rad)


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _choice(rng: Generator, place: str, kinds: dict[str, tuple[float, dict[str, float]]]) -> Any:
    """One of the laws by its probability; all are drawn, so that each number has its own place in the sequence."""
    name = str(rng.choice(list(kinds), p=[share for share, _ in kinds.values()]))
    return law(place, name, kinds[name][1])


def _torque_angle(rng: Generator) -> Any:
    fibre_rad, lengths, gamma = rng.uniform(0.8, 2.1), rng.uniform(0.3, 0.7), rng.uniform(0.25, 0.5)
    arm_rad, arm_least, sharpness = rng.uniform(1.3, 2.0), rng.uniform(0.2, 0.6), rng.uniform(0.8, 1.4)
    quadratic = 0.5 / rng.uniform(55.0, 100.0) ** 2
    linear = 2.0 * quadratic * (90.0 - rng.uniform(60.0, 110.0))
    fibre = {"lengths_per_rad": lengths, "gamma": gamma}
    arm = {"arm_best_rad": arm_rad, "arm_least": arm_least, "sharpness": sharpness}
    both = {**arm, "length_best_rad": fibre_rad, **fibre}
    return _choice(
        rng,
        "torque_angle",
        {
            "arm_and_length": (0.35, both),
            "force_length": (0.25, {"best_rad": fibre_rad, **fibre}),
            "moment_arm": (0.25, {"best_rad": arm_rad, "least": arm_least, "sharpness": sharpness}),
            "parabola": (0.15, {"linear_per_deg": linear, "quadratic_per_deg2": quadratic}),
        },
    )


def _torque_velocity(rng: Generator) -> Any:
    largest = {"largest_rad_s": _log_uniform(rng, 6.0, 22.0)}
    shape = {"curvature": rng.uniform(0.15, 0.6), "plateau": rng.uniform(1.2, 1.8)}
    bell = {"lost_per_rad_s": _log_uniform(rng, 0.03, 0.25), "v2_per_deg": rng.uniform(0.012, 0.035)}
    kinds = {"hill": (0.45, largest | shape), "logarithmic": (0.25, largest), "bell": (0.2, bell), "none": (0.1, {})}
    return _choice(rng, "torque_velocity", kinds)


def _passive(rng: Generator) -> Any:
    viscosity = {"viscosity_nm_s": _log_uniform(rng, 0.02, 0.5)}
    ends = {
        "extended_per_rad": rng.uniform(2.5, 7.0),
        "extended_rad": rng.uniform(0.1, 0.7),
        "flexed_per_rad": rng.uniform(2.5, 7.0),
        "flexed_rad": rng.uniform(1.9, 2.5),
        "constant_nm": rng.uniform(-0.4, 0.4),
    }
    fibres = {
        "flexor_nm": _log_uniform(rng, 1.5, 20.0),
        "flexor_lengths_per_rad": rng.uniform(0.35, 0.7),
        "flexor_slack_rad": rng.uniform(1.0, 1.8),
        "extensor_nm": _log_uniform(rng, 1.0, 10.0),
        "extensor_lengths_per_rad": rng.uniform(0.35, 0.7),
        "extensor_slack_rad": rng.uniform(1.2, 2.0),
    }
    rest = {"rest_rad": rng.uniform(1.1, 1.8)}
    linear = {"stiffness_nm_per_rad": _log_uniform(rng, 0.4, 5.0), "dry_nm": rng.uniform(0.0, 0.4), **rest}
    solid = {
        "stiffness_nm_per_rad": _log_uniform(rng, 0.5, 6.0),
        "lasting_share": rng.uniform(0.3, 0.8),
        "relaxation_s": _log_uniform(rng, 0.3, 3.0),
        **rest,
    }
    kinds = {
        "double_exponential": (0.35, ends | viscosity),
        "fibre_exponential": (0.25, fibres | viscosity),
        "linear_friction": (0.2, linear | viscosity),
        "standard_linear_solid": (0.2, solid | viscosity),
    }
    return _choice(rng, "passive", kinds)


def _mechanics(rng: Generator) -> Mechanics:
    inertia, weight = float(rng.uniform(0.04, 0.11)), _log_uniform(rng, 1.5, 4.0)
    upper_arm_deg = float(rng.uniform(0.0, 90.0))
    if rng.random() < 0.6:
        return Mechanics(inertia)
    return Mechanics(inertia, weight, upper_arm_deg)
