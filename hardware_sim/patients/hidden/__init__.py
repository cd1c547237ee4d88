"""Muscles with something hidden in them, drawn by a seed: physics written apart from the library that is to find it.

`make(seed)` gives the muscle and keeps its secret, `reveal(seed)` tells it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hardware_sim.patients.hidden.draw import Scenario
    from hardware_sim.patients.hidden.live import HiddenMuscle

__all__ = ["make", "reveal"]

NOISE_SD_NM = 0.04


@lru_cache(maxsize=8)
def _scenario(seed: int) -> Scenario:
    from hardware_sim.patients.hidden import draw

    rng = draw.rng_of(seed, "hidden patient")
    kind = str(rng.choice(["one", "nothing", "two", "outside"], p=[0.64, 0.12, 0.1, 0.14]))
    strength = str(rng.choice(["weak", "middle", "strong"], p=[0.2, 0.45, 0.35]))
    for attempt in range(20):
        still = [name for name in draw.effect_ids() if name not in draw.MOVING]
        names: tuple[str, ...] = ()
        if kind == "one":
            names = (str(rng.choice(still)),)
        elif kind == "two":
            names = draw.draw_pair(rng)
        elif kind == "outside":
            names = (str(rng.choice(draw.outside_ids())),)
        try:
            return draw.draw_scenario(names, strength, seed + attempt, noise_sd_nm=NOISE_SD_NM)
        except ValueError:  # no muscle shows this as strongly: draw something else
            continue
    raise ValueError(f"seed {seed}: no patient found; take another seed")


def make(seed: int) -> HiddenMuscle:
    """The patient that `seed` hides, at rest; the joint is held still.

    Parameters
    ----------
    seed
        Any whole number from 0.

    Raises
    ------
    ValueError
        A negative seed.
    """
    from hardware_sim.patients.hidden.live import HiddenMuscle

    return HiddenMuscle(_scenario(seed))


def reveal(seed: int) -> dict[str, Any]:
    """What `make(seed)` hides: `effects`, `formulation`, `strength`, `parameters`, `outside_library` and more."""
    return _scenario(seed).truth(NOISE_SD_NM) | {"seed": seed}
