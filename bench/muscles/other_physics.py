"""Muscles of other physics as wholes, drawn by set and seed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from bench.muscles.mechanism import Mechanism
from bench.muscles.physics import FURTHER, PHYSICS
from bench.muscles.physics_new import NEW
from bench.muscles.physics_places import PLACES
from bench.muscles.physics_report import REPORT
from stimrig.hardware_sim.hidden.base import Base, draw_base, recruit
from stimrig.hardware_sim.hidden.chain import Chain
from stimrig.hardware_sim.hidden.design import PULSES_PER_S
from stimrig.hardware_sim.hidden.kernels import Stage
from stimrig.hardware_sim.hidden.scenario import rng_of

SETS: dict[str, dict[str, Mechanism]] = {
    "physics": PHYSICS,
    "further": FURTHER,
    "places": PLACES,
    "new": NEW,
    "report": REPORT,
    "plain": {},
}
"""Kinds of muscles, which seeds take in turn; those of `plain` are of the library's own structure, and lack nothing."""
SIMULATION_HZ = 1600
STRENGTH = 0.6
"""Largest torque over that of a drawn plain muscle: 1.8 to 9 N·m."""


@dataclass(frozen=True)
class PhysicsMuscle:
    """A muscle of other physics, or a plain one: its base, its stages, its kind and the kind's numbers."""

    base: Base
    parts: tuple[Stage, ...]
    kind: str
    numbers: dict[str, float]

    def stages(self) -> list[Stage]:
        """All stages of the muscle."""
        return list(self.parts)


def draw_muscle(kinds: str, seed: int, rng: Generator | None = None) -> PhysicsMuscle:
    """The muscle of this set and seed: that of `record_of_physics`.

    Parameters
    ----------
    kinds
        One of `SETS`.
    seed
        Decides the kind and every number.
    rng
        Draws them; what more a record needs is drawn from it afterwards.

    Raises
    ------
    ValueError
        No such set.
    """
    if kinds not in SETS:
        raise ValueError(f"set {kinds!r}: one of {', '.join(SETS)}")
    rng = rng or rng_of(seed, "physics", kinds)
    base = draw_base(rng)
    names = list(SETS[kinds])
    if not names:
        return PhysicsMuscle(base, tuple(base.stages()), "plain", {})
    name = names[seed % len(names)]
    return _scaled(name, SETS[kinds][name], SETS[kinds][name].draw(rng, base), base, STRENGTH * base.largest_nm)


def _scaled(name: str, mechanism: Mechanism, numbers: dict[str, float], base: Base, most_nm: float) -> PhysicsMuscle:
    """Recruitment and mechanism, such that a fresh train of the largest pulses reaches this torque."""
    count = 3 * SIMULATION_HZ
    width_us, pulse, still = np.full(count, float(base.largest_width_us)), np.zeros(count), np.zeros(count)
    pulse[:: SIMULATION_HZ // PULSES_PER_S] = 1.0
    stages = [Stage(recruit, base.table_nm), Stage(mechanism.kernel, (1.0, *numbers.values()))]
    reached_nm = float(np.max(Chain(stages, base.largest_nm, 1.0 / SIMULATION_HZ).run(width_us, pulse, still, still)))
    stages[1] = replace(stages[1], parameters=(most_nm / reached_nm, *numbers.values()))
    return PhysicsMuscle(base, tuple(stages), name, numbers)
