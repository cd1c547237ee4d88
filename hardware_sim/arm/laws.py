"""The laws of the elbow's tissue: passive torque h(x, ẋ), and how active torque goes with angle and with velocity.

Angle 0 is the straight arm, flexion is positive, torque is in N·m. The muscle is a flexor: its fibres shorten as the
elbow flexes. A law's share of active torque at an angle is not scaled; `tissue` makes it 1 at the reference angle.
Shares are never below 0, and 1 at rest. All work on numbers and on arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Number = Any
"""A float or an array of floats; arrays of one call have shapes that broadcast."""
Floats = NDArray[np.float64]


def above(lowest: float, default: float) -> Any:
    """A parameter that must be above `lowest`."""
    return field(default=default, metadata={"above": lowest})


@dataclass(frozen=True)
class PassiveLaw:
    """Base of passive laws, by itself no tissue. Most have no memory: their torque follows from angle and velocity."""

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        """Passive torque after the joint has been there for long, N·m."""
        return 0.0 * angle_rad + 0.0 * velocity_rad_s

    def begin(self, angle_rad: float) -> float:  # noqa: ARG002
        """The memory of a joint that has been at this angle for long."""
        return 0.0

    def step(self, memory: float, angle_rad: float, step_s: float) -> float:  # noqa: ARG002
        """The memory one step later."""
        return memory

    def remembered_nm(self, memory: Number, angle_rad: Number) -> Number:  # noqa: ARG002
        """Return the torque that the memory adds to `torque_nm`, N·m."""
        return 0.0


@dataclass(frozen=True)
class DoubleExponential(PassiveLaw):
    """exp(-k_e (x - x_e)) - exp(k_f (x - x_f)) + c - b ẋ: exponentials at both ends of the range; x_e, x_f at 1 N·m.

    Riener and Edrich 1999 write the passive elastic moment of hip, knee and ankle as a sum of two exponentials and a
    constant, after Hatze 1997, who has elbow and shoulder too. The numbers here are not theirs: they give less than
    1 N·m between 25 and 125 degrees, and some N·m near the ends.
    """

    extended_per_rad: float = 4.0
    extended_rad: float = 0.35
    flexed_per_rad: float = 4.0
    flexed_rad: float = 2.25
    constant_nm: float = 0.0
    viscosity_nm_s: float = 0.1

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        extended_nm = np.exp(-self.extended_per_rad * (angle_rad - self.extended_rad))
        flexed_nm = np.exp(self.flexed_per_rad * (angle_rad - self.flexed_rad))
        return extended_nm - flexed_nm + self.constant_nm - self.viscosity_nm_s * velocity_rad_s


@dataclass(frozen=True)
class FibreExponential(PassiveLaw):
    """M_f p(1 + r_f (x_f - x)) - M_e p(1 + r_e (x - x_e)) - b ẋ: stretched fibres of a flexor and an extensor.

    p(l) = (exp(4 (l - 1) / 0.6) - 1) / (exp(4) - 1) is the passive force-length curve of De Groote, Kinney, Rao and
    Fregly 2016, 0 below the slack length. M is the torque at a stretch of 0.6 lengths, x where the fibre is slack.
    """

    flexor_nm: float = 6.0
    flexor_lengths_per_rad: float = 0.5
    flexor_slack_rad: float = 1.3
    extensor_nm: float = 5.0
    extensor_lengths_per_rad: float = 0.4
    extensor_slack_rad: float = 1.5
    viscosity_nm_s: float = 0.15

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        flexor = _fibre_force(self.flexor_lengths_per_rad * (self.flexor_slack_rad - angle_rad))
        extensor = _fibre_force(self.extensor_lengths_per_rad * (angle_rad - self.extensor_slack_rad))
        return self.flexor_nm * flexor - self.extensor_nm * extensor - self.viscosity_nm_s * velocity_rad_s


def _fibre_force(stretch: Number) -> Number:
    stiffness, strain = 4.0, 0.6
    return np.expm1(stiffness * np.maximum(stretch, 0.0) / strain) / np.expm1(stiffness)


@dataclass(frozen=True)
class LinearFriction(PassiveLaw):
    """-k (x - x_0) - b ẋ - d tanh(ẋ / v_0): a spring, a dashpot and dry friction.

    The linear second-order joint of many tests of limb impedance (Agarwal and Gottlieb 1977; Wiegner and Watts 1986
    for the relaxed elbow) with Coulomb's friction, smooth at rest. The numbers are of their order of magnitude.
    """

    stiffness_nm_per_rad: float = 1.5
    rest_rad: float = 1.4
    viscosity_nm_s: float = 0.15
    dry_nm: float = 0.15
    smooth_rad_s: float = above(0.0, 0.05)

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        elastic_nm = -self.stiffness_nm_per_rad * (angle_rad - self.rest_rad)
        dry_nm = self.dry_nm * np.tanh(velocity_rad_s / self.smooth_rad_s)
        return elastic_nm - self.viscosity_nm_s * velocity_rad_s - dry_nm


@dataclass(frozen=True)
class StandardLinearSolid(PassiveLaw):
    """-k (s (x - x_0) + (1 - s) (x - z)) - b ẋ, τ z' = x - z: a spring beside a spring and dashpot, Fung 1981.

    After a movement the part (1 - s) of the stiffness relaxes with the time constant τ. So h is no function of x and ẋ
    alone: `torque_nm` is that of a joint which has been there for long, and `remembered_nm` comes to it. The memory is
    the dashpot's angle z.
    """

    stiffness_nm_per_rad: float = 2.0
    lasting_share: float = 0.6
    rest_rad: float = 1.4
    relaxation_s: float = above(0.0, 1.0)
    viscosity_nm_s: float = 0.05

    def torque_nm(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        lasting_nm = -self.stiffness_nm_per_rad * self.lasting_share * (angle_rad - self.rest_rad)
        return lasting_nm - self.viscosity_nm_s * velocity_rad_s

    def begin(self, angle_rad: float) -> float:
        return angle_rad

    def step(self, memory: float, angle_rad: float, step_s: float) -> float:
        """Exact for an angle that stays."""
        return angle_rad + (memory - angle_rad) * math.exp(-step_s / self.relaxation_s)

    def remembered_nm(self, memory: Number, angle_rad: Number) -> Number:
        return -self.stiffness_nm_per_rad * (1.0 - self.lasting_share) * (angle_rad - memory)


@dataclass(frozen=True)
class MomentArm:
    """r_0 + (1 - r_0) cos(c (x - x_best)): a moment arm, largest in mid-range, as that of biceps brachii.

    In the shape of the measurements of Murray, Delp and Buchanan 1995; their elbow flexors have peaks between 90 and
    110 degrees or so. c makes both slopes; r_0 is what is left where the cosine is 0, and beyond.
    """

    best_rad: float = 1.6
    least: float = 0.4
    sharpness: float = 1.1

    def share(self, angle_rad: Number) -> Number:
        turn = np.clip(self.sharpness * (angle_rad - self.best_rad), -0.5 * math.pi, 0.5 * math.pi)
        return self.least + (1.0 - self.least) * np.cos(turn)


@dataclass(frozen=True)
class ForceLength:
    """A Gaussian of the fibre's length, exp(-(l - 1)² / γ), l = 1 + r (x_best - x); Thelen 2003, γ = 0.45."""

    best_rad: float = 1.4
    lengths_per_rad: float = 0.5
    gamma: float = above(0.0, 0.45)

    def share(self, angle_rad: Number) -> Number:
        stretch = self.lengths_per_rad * (self.best_rad - angle_rad)
        return np.exp(-stretch * stretch / self.gamma)


@dataclass(frozen=True)
class ArmAndLength:
    """The moment arm times the force of fibres whose length follows the joint."""

    arm_best_rad: float = 1.7
    arm_least: float = 0.45
    sharpness: float = 1.1
    length_best_rad: float = 1.2
    lengths_per_rad: float = 0.45
    gamma: float = above(0.0, 0.45)

    def share(self, angle_rad: Number) -> Number:
        arm = MomentArm(self.arm_best_rad, self.arm_least, self.sharpness)
        fibre = ForceLength(self.length_best_rad, self.lengths_per_rad, self.gamma)
        return arm.share(angle_rad) * fibre.share(angle_rad)


@dataclass(frozen=True)
class Parabola:
    """1 + A Δ - B Δ², Δ = 90° - θ, never below `least`, after Marion, Wexler and Hull 2010.

    Their A and B are 0.0344 and 4.49e-4 per degree, of the quadriceps. With these an elbow would have no torque beyond
    118 degrees, so the default takes a flatter one of the same form, most at 80 degrees.
    """

    linear_per_deg: float = 0.002
    quadratic_per_deg2: float = 1.0e-4
    least: float = above(0.0, 0.05)

    def share(self, angle_rad: Number) -> Number:
        off_deg = 90.0 - np.degrees(angle_rad)
        share = 1.0 + self.linear_per_deg * off_deg - self.quadratic_per_deg2 * off_deg * off_deg
        return np.maximum(share, self.least)


@dataclass(frozen=True)
class AnyAngle:
    """Active torque is the same at every angle."""

    def share(self, angle_rad: Number) -> Number:
        return 1.0 + 0.0 * angle_rad


@dataclass(frozen=True)
class Hill:
    """Hill's hyperbola (1938), and where it is stretched one that rises to a plateau (Katz 1939), of one slope at rest.

    shortening: (1 - v) / (1 + v / a); stretched: 1 + (p - 1) s |v| / (p - 1 + s |v|), s = 1 + 1 / a; v = ẋ / v_max
    """

    largest_rad_s: float = above(0.0, 15.0)
    curvature: float = above(0.0, 0.3)
    plateau: float = above(1.0, 1.5)

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        v = velocity_rad_s / self.largest_rad_s + 0.0 * angle_rad
        shortening = np.clip(v, 0.0, 1.0)
        stretched = (1.0 + 1.0 / self.curvature) * np.maximum(-v, 0.0)
        gain = self.plateau - 1.0
        return (1.0 - shortening) / (1.0 + shortening / self.curvature) + gain * stretched / (gain + stretched)


D1, D2, D3, D4 = -0.318, -8.149, -0.374, 0.886


@dataclass(frozen=True)
class Logarithmic:
    """d1 log(d2 v + d3 + sqrt((d2 v + d3)² + 1)) + d4 over its value at rest; De Groote, Kinney, Rao, Fregly 2016."""

    largest_rad_s: float = above(0.0, 15.0)

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        stretched = -velocity_rad_s / self.largest_rad_s + 0.0 * angle_rad
        return np.maximum((D1 * np.arcsinh(D2 * stretched + D3) + D4) / (D1 * math.asinh(D3) + D4), 0.0)


@dataclass(frozen=True)
class Bell:
    """1 - s b(θ) ẋ, b = V2 θ exp(1 - V2 θ): velocity times a bell of the angle, after Marion, Wexler and Hull 2010.

    Their force loses V1 θ exp(-V2 θ) θ', θ in degrees, V2 = 0.0229. Here the bell's peak is 1, at 1 / V2 degrees. A
    stretched muscle gains no more than `plateau`.
    """

    lost_per_rad_s: float = 0.15
    v2_per_deg: float = 0.0229
    plateau: float = above(1.0, 1.8)

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        turn = self.v2_per_deg * np.maximum(np.degrees(angle_rad), 0.0)
        bell = turn * np.exp(1.0 - turn)
        return np.clip(1.0 - self.lost_per_rad_s * bell * velocity_rad_s, 0.0, self.plateau)


@dataclass(frozen=True)
class AnyVelocity:
    """Active torque is the same at every velocity."""

    def share(self, angle_rad: Number, velocity_rad_s: Number) -> Number:
        return 1.0 + 0.0 * angle_rad + 0.0 * velocity_rad_s


LAWS: dict[str, dict[str, Any]] = {
    "passive": {
        "double_exponential": DoubleExponential,
        "fibre_exponential": FibreExponential,
        "linear_friction": LinearFriction,
        "none": PassiveLaw,
        "standard_linear_solid": StandardLinearSolid,
    },
    "torque_angle": {
        "arm_and_length": ArmAndLength,
        "force_length": ForceLength,
        "moment_arm": MomentArm,
        "none": AnyAngle,
        "parabola": Parabola,
    },
    "torque_velocity": {"bell": Bell, "hill": Hill, "logarithmic": Logarithmic, "none": AnyVelocity},
}
"""By place and name, in alphabetical order."""
