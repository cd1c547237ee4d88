"""Drawing a muscle with something hidden in it, by a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import numpy as np
from numpy.random import Generator

from hardware_sim.patients.hidden import effects, kept_back, outside, outside_kept
from hardware_sim.patients.hidden.base import Base, draw_base
from hardware_sim.patients.hidden.kernels import Formulation, NotSuited, Stage
from hardware_sim.patients.hidden.protocol import Protocol40, make_design
from hardware_sim.patients.hidden.scenario import BANDS, Hidden, combine, jsonable, set_size

ATTEMPTS = 40
CALIBRATION_STEP_S = 1.0 / 1600.0

KEPT_BACK_FROM = 1000
"""Seeds from here on may draw formulations that no lower seed draws."""

MOVING = frozenset({"torque_angle", "torque_velocity", "passive_torque"})
"""Show only where the joint moves."""

Writer = Callable[[Generator, Base], Formulation]


@cache
def effect_ids() -> tuple[str, ...]:
    """Effects the library names, one file each."""
    return tuple(sorted(module.name for module in iter_modules(effects.__path__)))


@cache
def outside_ids() -> tuple[str, ...]:
    """Effects no library names."""
    return tuple(sorted(module.name for module in iter_modules(outside.__path__)))


@cache
def outside_kept_ids() -> tuple[str, ...]:
    """More of them, which nobody who tunes a diagnosis looks at."""
    return tuple(sorted(module.name for module in iter_modules(outside_kept.__path__)))


def formulations(effect: str, seed: int = KEPT_BACK_FROM) -> tuple[Writer, ...]:
    """The ways an effect is written here; under seed 1000 without those kept back from development.

    Raises
    ------
    ValueError
        No effect of that name.
    """
    for foreign, known in ((outside, outside_ids()), (outside_kept, outside_kept_ids())):
        if effect in known:
            return import_module(f"{foreign.__name__}.{effect}").FORMULATIONS
    if effect not in effect_ids():
        raise ValueError(f"effect {effect!r}: one of {', '.join((*effect_ids(), *outside_ids()))}")
    written = import_module(f"{effects.__name__}.{effect}").FORMULATIONS
    if seed < KEPT_BACK_FROM or effect not in {module.name for module in iter_modules(kept_back.__path__)}:
        return written
    return (*written, *import_module(f"{kept_back.__name__}.{effect}").FORMULATIONS)


@dataclass(frozen=True)
class Scenario:
    """A base muscle, what is hidden in it, and the design the sizes were set on."""

    base: Base
    hidden: tuple[Hidden, ...]
    design: Protocol40

    def stages(self) -> list[Stage]:
        """All stages of the muscle."""
        return combine(self.base, [(one.formulation, one.magnitude) for one in self.hidden])

    def truth(self, noise_sd_nm: float) -> dict[str, Any]:
        """What is hidden, plainly."""
        return {
            "effects": [one.effect for one in self.hidden],
            "formulation": [one.formulation.name for one in self.hidden],
            "source": [one.formulation.source for one in self.hidden],
            "strength": self.hidden[0].strength if self.hidden else "none",
            "parameters": {
                one.effect: jsonable({one.formulation.magnitude: one.magnitude, **one.formulation.parameters})
                for one in self.hidden
            },
            "outside_library": any(one.effect not in effect_ids() for one in self.hidden),
            "excess": {one.effect: jsonable(one.excess) for one in self.hidden},
            "excess_over_noise": [round(one.excess["counted_nm"] / noise_sd_nm, 3) for one in self.hidden],
            "base": jsonable(self.base.describe()),
        }


def rng_of(seed: int, *labels: str) -> Generator:
    """A generator of its own for a seed and labels."""
    return np.random.default_rng([seed, *(zlib.crc32(label.encode()) for label in labels)])


def draw_scenario(
    names: tuple[str, ...],
    strength: str,
    seed: int,
    *,
    noise_sd_nm: float = 0.04,
    steep: bool = False,
    moving: bool = False,
    pulsed: bool = False,
    formulation: int | None = None,
    design: str = "full",
    **design_settings: Any,
) -> Scenario:
    """A scenario with the effects `names`, each of the given strength on its own.

    Bases, formulations and sizes are drawn until the strength's band can be reached.

    Raises
    ------
    ValueError
        Unknown effect, strength or design; or no muscle found that shows the effect this strongly.
    """
    if strength not in BANDS:
        raise ValueError(f"strength {strength!r}: one of {', '.join(BANDS)}")
    moving = moving or bool(MOVING & set(names))
    low, high = BANDS[strength]
    for attempt in range(ATTEMPTS):
        rng = rng_of(seed, *names, strength, str(attempt))
        base = draw_base(rng, steep)
        if pulsed:
            base = replace(base, burst_s=float(rng.uniform(0.003, 0.012)))
        sequence = make_design(design, rng, float(base.largest_width_us), moving=moving, **design_settings)
        hidden: list[Hidden] = []
        try:
            for name in names:
                writers = formulations(name, seed)
                choice = int(rng.integers(len(writers))) if formulation is None else formulation
                written = writers[choice](rng, base)
                target = noise_sd_nm * float(np.exp(rng.uniform(np.log(low * 1.08), np.log(min(high, 20.0) * 0.92))))
                band = noise_sd_nm * low, noise_sd_nm * high
                size, excess = set_size(name, written, base, sequence, target, band, CALIBRATION_STEP_S)
                hidden.append(Hidden(name, written, size, strength, excess))
            combine(base, [(one.formulation, one.magnitude) for one in hidden])
        except NotSuited:
            continue
        return Scenario(base, tuple(hidden), sequence)
    raise ValueError(f"{' and '.join(names)}, {strength}: no muscle found that shows it this strongly")


def draw_pair(rng: Generator) -> tuple[str, str]:
    """Two different effects of the library that need no movement."""
    still = [name for name in effect_ids() if name not in MOVING]
    first, second = rng.choice(len(still), 2, replace=False)
    return still[int(first)], still[int(second)]
