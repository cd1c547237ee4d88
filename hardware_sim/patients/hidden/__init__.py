"""Muscles with hidden effects, drawn by a seed. Their physics shares no code with the library that must find them.

`make(seed)` gives the muscle without saying what is hidden, `reveal(seed)` says it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stimrig.hardware_sim.patients.hidden.draw import Scenario
    from stimrig.hardware_sim.patients.hidden.live import HiddenMuscle

__all__ = ["drawn", "make", "movement", "reveal"]

NOISE_SD_NM = 0.04


MOVING_KINDS = {"moving": 0.7, "nothing": 0.15, "still": 0.15}
"""What the seed of a patient whose joint moves hides: an effect of the movement, nothing, an effect of the library that
shows at any joint; its probability."""


@lru_cache(maxsize=8)
def _scenario(seed: int, moving: bool) -> Scenario:
    from stimrig.hardware_sim.patients.hidden import draw

    rng = draw.rng_of(seed, "hidden patient, moving" if moving else "hidden patient")
    kinds = MOVING_KINDS if moving else {"one": 0.64, "nothing": 0.12, "two": 0.1, "outside": 0.14}
    kind = str(rng.choice(list(kinds), p=list(kinds.values())))
    strength = str(rng.choice(["weak", "middle", "strong"], p=[0.2, 0.45, 0.35]))
    for attempt in range(20):
        names: tuple[str, ...] = ()
        if kind in ("one", "still"):
            names = (str(rng.choice(draw.still_effect_ids())),)
        elif kind == "moving":
            names = (str(rng.choice(sorted(draw.MOVING))),)
        elif kind == "two":
            names = draw.draw_pair(rng)
        elif kind == "outside":
            names = (str(rng.choice(draw.outside_ids())),)
        try:
            return draw.draw_scenario(names, strength, seed + attempt, noise_sd_nm=NOISE_SD_NM, moving=moving)
        except ValueError:  # no muscle shows this effect so strongly: draw another
            continue
    raise ValueError(f"seed {seed}: no patient found; take another seed")


def make(seed: int, moving: bool = False) -> HiddenMuscle:
    """The patient that `seed` hides, at rest.

    Parameters
    ----------
    seed
        Any whole number from 0.
    moving
        Its joint will move: another patient, whose effect may show only then (`MOVING_KINDS`).

    Raises
    ------
    ValueError
        A negative seed.
    """
    from stimrig.hardware_sim.patients.hidden.live import HiddenMuscle

    return HiddenMuscle(_scenario(seed, moving))


def movement(seed: int) -> dict[str, Any]:
    """How the joint of the moving patient moves in the test that its effect was sized on: settings of `waves`."""
    hz, amplitude_rad, phase_rad = _scenario(seed, True).design.movement or ((), (), ())
    deg = [math.degrees(size) for size in amplitude_rad]
    return {"hz": list(map(float, hz)), "deg": deg, "phase_rad": list(map(float, phase_rad))}


def reveal(seed: int, moving: bool = False) -> dict[str, Any]:
    """What `make(seed)` hides: `effects`, `formulation`, `strength`, `parameters`, `outside_library` and more."""
    return _scenario(seed, moving).truth(NOISE_SD_NM) | {"seed": seed}


def drawn(seed: int, moving: bool = False) -> Scenario:
    """The patient with its design, for records off line."""
    return _scenario(seed, moving)
