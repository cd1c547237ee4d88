"""Muscles with hidden effects, drawn by a seed. Their physics shares no code with the library that must find them.

`make(seed)` gives the muscle without saying what is hidden, `reveal(seed)` says it.
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
        names: tuple[str, ...] = ()
        if kind == "one":
            names = (str(rng.choice(draw.still_effect_ids())),)
        elif kind == "two":
            names = draw.draw_pair(rng)
        elif kind == "outside":
            names = (str(rng.choice(draw.outside_ids())),)
        try:
            return draw.draw_scenario(names, strength, seed + attempt, noise_sd_nm=NOISE_SD_NM)
        except ValueError:  # no muscle shows this effect so strongly: draw another
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
