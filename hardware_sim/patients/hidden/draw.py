"""Drawing a muscle with hidden effects by a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden import effects, outside, outside_kept
from stimrig.hardware_sim.patients.hidden.base import Base, draw_base
from stimrig.hardware_sim.patients.hidden.design import Design, make_design
from stimrig.hardware_sim.patients.hidden.kernels import Formulation, NotSuited, Stage
from stimrig.hardware_sim.patients.hidden.scenario import BANDS, HiddenEffect, combine, find_magnitude, jsonable

ATTEMPTS = 40
CALIBRATION_STEP_S = 1.0 / 1600.0

KEPT_BACK_FROM = 1000
"""Seeds from here on may also draw an effect's formulations `KEPT_BACK`: nobody develops on them, so they tell how a
diagnosis generalises."""

MOVING = frozenset({"torque_angle", "torque_velocity", "passive_torque"})
"""These effects show only where the joint moves."""

Writer = Callable[[Generator, Base], Formulation]


def _files_of(package: ModuleType) -> tuple[str, ...]:
    return tuple(sorted(module.name for module in iter_modules(package.__path__)))


def effect_ids() -> tuple[str, ...]:
    """Effects that the library has, one file each."""
    return _files_of(effects)


def outside_ids() -> tuple[str, ...]:
    """Effects that no library has."""
    return _files_of(outside)


def outside_kept_ids() -> tuple[str, ...]:
    """More of them, which nobody who tunes a diagnosis may look at."""
    return _files_of(outside_kept)


def still_effect_ids() -> list[str]:
    """Effects of the library that show while the joint is held still."""
    return [name for name in effect_ids() if name not in MOVING]


def formulations(effect: str, seed: int = KEPT_BACK_FROM) -> tuple[Writer, ...]:
    """The formulations of an effect; under seed 1000 without those kept back from development.

    Raises
    ------
    ValueError
        No effect of that name.
    """
    for package in (outside, outside_kept):
        if effect in _files_of(package):
            return import_module(f"{package.__name__}.{effect}").FORMULATIONS
    if effect not in effect_ids():
        raise ValueError(f"effect {effect!r}: one of {', '.join((*effect_ids(), *outside_ids()))}")
    module = import_module(f"{effects.__name__}.{effect}")
    return module.FORMULATIONS if seed < KEPT_BACK_FROM else (*module.FORMULATIONS, *module.KEPT_BACK)


@dataclass(frozen=True)
class Scenario:
    """A base muscle, its hidden effects, and the design on which their magnitudes were found."""

    base: Base
    hidden: tuple[HiddenEffect, ...]
    design: Design

    def stages(self) -> list[Stage]:
        """All stages of the muscle."""
        return combine(self.base, [(one.formulation, one.magnitude) for one in self.hidden])

    def truth(self, noise_sd_nm: float) -> dict[str, Any]:
        """What is hidden, as plain values."""
        return {
            "effects": [one.effect for one in self.hidden],
            "formulation": [one.formulation.name for one in self.hidden],
            "source": [one.formulation.source for one in self.hidden],
            "strength": self.hidden[0].strength if self.hidden else "none",
            "parameters": {
                one.effect: jsonable({one.formulation.magnitude_name: one.magnitude, **one.formulation.parameters})
                for one in self.hidden
            },
            "outside_library": any(one.effect not in effect_ids() for one in self.hidden),
            "excess": {one.effect: jsonable(one.excess) for one in self.hidden},
            "excess_over_noise": [round(one.excess["counted_nm"] / noise_sd_nm, 3) for one in self.hidden],
            "base": jsonable(self.base.describe()),
        }


def rng_of(seed: int, *labels: str) -> Generator:
    """The random generator of this seed and these labels."""
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

    Bases, formulations and magnitudes are drawn until the strength's band is reached.

    Raises
    ------
    ValueError
        Unknown effect, strength or design; or no muscle found that shows the effect this strongly.
    """
    if strength not in BANDS:
        raise ValueError(f"strength {strength!r}: one of {', '.join(BANDS)}")
    moving = moving or bool(MOVING & set(names))
    for attempt in range(ATTEMPTS):
        rng = rng_of(seed, *names, strength, str(attempt))
        base = draw_base(rng, steep)
        if pulsed:
            base = replace(base, burst_s=float(rng.uniform(0.003, 0.012)))
        sequence = make_design(design, rng, float(base.largest_width_us), moving=moving, **design_settings)
        try:
            hidden = tuple(
                _draw_effect(rng, name, strength, noise_sd_nm, base, sequence, formulations(name, seed), formulation)
                for name in names
            )
            combine(base, [(one.formulation, one.magnitude) for one in hidden])
        except NotSuited:
            continue
        return Scenario(base, hidden, sequence)
    raise ValueError(f"{' and '.join(names)}, {strength}: no muscle found that shows it this strongly")


def _draw_effect(
    rng: Generator,
    effect: str,
    strength: str,
    noise_sd_nm: float,
    base: Base,
    design: Design,
    writers: tuple[Writer, ...],
    choice: int | None,
) -> HiddenEffect:
    """One effect of this strength on this base; `choice` is its formulation, drawn if None."""
    low, high = BANDS[strength]
    formulation = writers[int(rng.integers(len(writers))) if choice is None else choice](rng, base)
    target_nm = noise_sd_nm * float(np.exp(rng.uniform(np.log(low * 1.08), np.log(min(high, 20.0) * 0.92))))
    band_nm = noise_sd_nm * low, noise_sd_nm * high
    magnitude, excess = find_magnitude(effect, formulation, base, design, target_nm, band_nm, CALIBRATION_STEP_S)
    return HiddenEffect(effect, formulation, magnitude, strength, excess)


def draw_pair(rng: Generator) -> tuple[str, str]:
    """Two different effects of the library that need no movement."""
    still = still_effect_ids()
    first, second = rng.choice(len(still), 2, replace=False)
    return still[int(first)], still[int(second)]
