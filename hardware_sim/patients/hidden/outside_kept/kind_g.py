"""Two clocks that do not agree: the torque's time runs away from the stimulator's."""

from __future__ import annotations

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base, delayed
from stimrig.hardware_sim.patients.hidden.kernels import STEP_S, TIME_S, Formulation, Stage, kernel


@kernel("structure")
def _running_away(x, p, s, c):
    """p: s a s, time after which the clocks are set alike again s. s[0]: place in the ring of 1000."""
    return delayed(x, min(p[0] * (c[TIME_S] % p[1]) / c[STEP_S], 990.0), s, 10, 1000)


def running_away(rng: Generator, _base: Base) -> Formulation:
    again = float(rng.choice([1e6, rng.uniform(9.0, 20.0)]))
    return Formulation(
        "the delay grows with time",
        "two free-running crystals; setting them alike now and then",
        lambda m: [Stage(_running_away, (m, again))],
        0.012 if again > 1e5 else 0.025,
        "s_per_s",
        {"set_alike_after_s": again},
    )


FORMULATIONS = (running_away,)
