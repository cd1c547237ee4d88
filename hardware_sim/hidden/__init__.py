"""Muscles with hidden effects, drawn by a seed. Their physics shares no code with the library that must find them.

`make(seed)` gives the muscle without saying what is hidden, `reveal(seed)` says it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stimrig.hardware_sim.hidden.live import HiddenMuscle
    from stimrig.hardware_sim.hidden.scenario import Scenario

__all__ = ["draw_patient", "make", "movement", "reveal"]

NOISE_SD_NM = 0.04
KINDS = {"one": 0.64, "nothing": 0.12, "two": 0.1, "outside": 0.14}
"""Hidden effects that a patient's seed draws, with their probabilities: of the library, or outside it."""
MOVING_KINDS = {"moving": 0.7, "nothing": 0.15, "one": 0.15}
"""The same of a patient whose joint moves: mostly an effect of the movement."""


@lru_cache(maxsize=8)
def draw_patient(seed: int, moving: bool = False) -> Scenario:
    """The patient that `seed` hides, with its design, for records off line; as `make`."""
    from stimrig.hardware_sim.hidden import library
    from stimrig.hardware_sim.hidden import scenario as scenarios

    rng = scenarios.rng_of(seed, "hidden patient, moving" if moving else "hidden patient")
    kinds = MOVING_KINDS if moving else KINDS
    kind = str(rng.choice(list(kinds), p=list(kinds.values())))
    strength = str(rng.choice(["weak", "middle", "strong"], p=[0.2, 0.45, 0.35]))
    pools = {"one": library.STILL, "moving": sorted(library.MOVING), "outside": list(library.OUTSIDERS)}
    for attempt in range(20):
        names = scenarios.draw_pair(rng) if kind == "two" else (str(rng.choice(pools[kind])),) if kind in pools else ()
        try:
            return scenarios.draw_scenario(names, strength, seed + attempt, noise_sd_nm=NOISE_SD_NM, moving=moving)
        except ValueError:  # no muscle shows this effect so strongly: draw another
            continue
    raise ValueError(f"seed {seed}: no patient found; take another seed")


def make(seed: int, moving: bool = False) -> HiddenMuscle:
    """The patient that `seed` hides, at rest; if `moving` another one, whose effect may show only then
    (`MOVING_KINDS`).

    Raises ValueError: a negative seed.
    """
    from stimrig.hardware_sim.hidden.live import HiddenMuscle

    return HiddenMuscle(draw_patient(seed, moving))


def movement(seed: int) -> dict[str, Any]:
    """Return the movement in the test that sized the moving patient's effect, as settings of `waves`."""
    hz, amplitude_rad, phase_rad = draw_patient(seed, True).design.movement or ((), (), ())
    deg = [math.degrees(size) for size in amplitude_rad]
    return {"hz": list(map(float, hz)), "deg": deg, "phase_rad": list(map(float, phase_rad))}


def reveal(seed: int, moving: bool = False) -> dict[str, Any]:
    """Return the truth of a seed: `effects`, `formulation`, `strength`, `parameters`, `outside_library` and more."""
    return draw_patient(seed, moving).truth(NOISE_SD_NM) | {"seed": seed}
