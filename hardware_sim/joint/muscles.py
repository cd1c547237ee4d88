"""Two muscles and their joint: motor units that either electrode may reach, dynamics, and a joint that muscles stiffen.

Each muscle is a pool of units of equal torque. A unit fires at a pulse of its own electrode from its own threshold on,
and if the other electrode reaches it, at a pulse of that one from another threshold on. It is then active for the hold
of 25 ms. A unit that both electrodes excite is one unit: it is kept active, and gives no more torque.

    F'' T² / v² + 2 ζ T F' / v + F = (1 - depth · q) · active,  v = 1 + faster · F / top,  τ q' = active / top - q

The fixture yields a little, and active muscles resist that: joint torque = (F_a - F_b) / (1 + k_a F_a / largest_a + k_b
F_b / largest_b), where k is a fully active muscle's stiffness over the fixture's. So a muscle alone already loses some.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stimrig.hardware_sim.hidden.base import Base, second_order_step
from stimrig.hardware_sim.hidden.kernels import Floats, helper

STEPS_PER_S = 1600
HOLD_S = 0.025
NOMINAL_CURRENT_MA = 20.0
STATES = 3
"""Of each muscle: torque, its rate, fatigue."""


@dataclass(frozen=True, eq=False)
class JointMuscle:
    """One muscle; thresholds are pulse widths at 20 mA, µs, and infinite where an electrode does not reach a unit."""

    base: Base
    own_us: Floats  # shape (units,)
    other_us: Floats  # of the other muscle's electrode
    unit_nm: float
    fatigue_depth: float = 0.0
    fatigue_s: float = 40.0
    faster: float = 0.0

    def active_nm(self, own_us: Floats, other_us: Floats) -> Floats:
        """Steady torque of a train whose held widths at 20 mA are these, shape (n,)."""
        fires = (own_us[:, None] >= self.own_us) | (other_us[:, None] >= self.other_us)
        return self.unit_nm * fires.sum(axis=1)

    @property
    def largest_width_us(self) -> float:
        """The largest pulse that its own electrode is sent."""
        return float(self.base.largest_width_us)

    @property
    def largest_nm(self) -> float:
        """Steady torque of its own electrode's largest pulse."""
        return float(self.active_nm(np.array([self.largest_width_us]), np.zeros(1))[0])


@dataclass(frozen=True, eq=False)
class Joint:
    """Agonist (flexes) and antagonist, and how much stiffer each makes the joint."""

    seed: int
    agonist: JointMuscle
    antagonist: JointMuscle
    stiffness: tuple[float, float]
    parameters: Floats = field(init=False)  # for `run`, shape (2, 7)

    def __post_init__(self) -> None:
        rows = [
            [1.0 / one.base.t_omega_s, one.base.zeta, one.largest_nm, one.fatigue_depth, one.fatigue_s, one.faster, k]
            for one, k in zip(self.muscles, self.stiffness, strict=True)
        ]
        object.__setattr__(self, "parameters", np.array(rows))

    @property
    def muscles(self) -> tuple[JointMuscle, JointMuscle]:
        """Agonist, antagonist."""
        return self.agonist, self.antagonist

    def active_nm(self, widths_us: Floats) -> Floats:
        """What each muscle's active units would give in the end, for held widths at 20 mA of shape (n, 2)."""
        first, second = widths_us[:, 0], widths_us[:, 1]
        return np.stack([self.agonist.active_nm(first, second), self.antagonist.active_nm(second, first)], axis=1)

    @property
    def cross_talk(self) -> tuple[float, float]:
        """Agonist's electrode on the antagonist, and the other way round.

        The torque that the other muscle gives by an electrode's largest pulse alone, over that by its own electrode's.
        """
        alone = self.active_nm(np.diag([one.largest_width_us for one in self.muscles]))
        return float(alone[0, 1] / self.antagonist.largest_nm), float(alone[1, 0] / self.agonist.largest_nm)

    @property
    def co_contraction(self) -> float:
        """Share of the joint's torque that is lost with both muscles fully active."""
        return 1.0 - 1.0 / (1.0 + sum(self.stiffness))

    @property
    def truth(self) -> dict[str, Any]:
        """What was drawn, as plain values."""
        muscles = [
            {
                **one.base.describe(),
                "largest_torque_nm": one.largest_nm,
                "fatigue_depth": one.fatigue_depth,
                "fatigue_s": one.fatigue_s if one.fatigue_depth else None,
                "faster_by_activation": one.faster,
            }
            for one in self.muscles
        ]
        interplay = {"cross_talk": list(self.cross_talk), "co_contraction": self.co_contraction}
        return {"seed": self.seed, "muscles": muscles, **interplay, "stiffness": list(self.stiffness)}


@helper
def run(active_nm: Any, p: Any, s: Any, out: Any) -> None:
    """Advance one step of 1/1600 s for each row of `active_nm`; `out` gets (F_a, F_b, torque) after each.

    `p` are a joint's parameters, `s` its state, shape (2, STATES), which is changed.
    """
    step_s = 1.0 / STEPS_PER_S
    for k in range(active_nm.shape[0]):
        soft = 1.0
        for m in range(2):
            speed = max(0.2, 1.0 + p[m, 5] * s[m, 0] / p[m, 2])
            drive = active_nm[k, m] * (1.0 - p[m, 3] * s[m, 2])
            s[m, 2] += step_s / p[m, 4] * (active_nm[k, m] / p[m, 2] - s[m, 2])
            second_order_step(drive, p[m, 0] * speed, p[m, 1], s[m], 0, step_s)
            soft += p[m, 6] * max(s[m, 0], 0.0) / p[m, 2]
            out[k, m] = s[m, 0]
        out[k, 2] = (s[0, 0] - s[1, 0]) / soft
