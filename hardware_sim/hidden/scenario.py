"""Drawing a muscle with hidden effects by a seed."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator

from stimrig.hardware_sim.hidden.base import Base, draw_base
from stimrig.hardware_sim.hidden.chain import combine
from stimrig.hardware_sim.hidden.design import Design, make_design
from stimrig.hardware_sim.hidden.forms import Effect, Form
from stimrig.hardware_sim.hidden.kernels import NotSuited, Stage
from stimrig.hardware_sim.hidden.library import EFFECTS, MOVING, STILL, find_effect, find_forms
from stimrig.hardware_sim.hidden.strength import find_magnitude

BANDS = {"weak": (2.0, 5.0), "middle": (5.0, 10.0), "strong": (10.0, 25.0)}
"""Excess error over the noise's standard deviation."""
ATTEMPTS = 40


@dataclass(frozen=True)
class HiddenEffect:
    """One effect: its form, its magnitude, and the error that a fit without it leaves."""

    effect: str
    form: Form
    magnitude: float
    strength: str
    excess: dict[str, float]


@dataclass(frozen=True)
class Scenario:
    """A base muscle, its hidden effects, and the design on which their magnitudes were found."""

    base: Base
    hidden: tuple[HiddenEffect, ...]
    design: Design

    def stages(self) -> list[Stage]:
        """All stages of the muscle."""
        return combine(self.base, [(effect.form, effect.magnitude) for effect in self.hidden])

    def truth(self, noise_sd_nm: float) -> dict[str, Any]:
        """Return the hidden effects and their parameters as plain values."""
        forms = [(effect, effect.form) for effect in self.hidden]
        return jsonable(
            {
                "effects": [effect.effect for effect in self.hidden],
                "formulation": [form.name for _, form in forms],
                "source": [form.source for _, form in forms],
                "strength": self.hidden[0].strength if self.hidden else "none",
                "parameters": {
                    effect.effect: {form.magnitude_name: effect.magnitude, **form.parameters} for effect, form in forms
                },
                "outside_library": any(effect.effect not in EFFECTS for effect in self.hidden),
                "excess": {effect.effect: effect.excess for effect in self.hidden},
                "excess_over_noise": [round(effect.excess["counted_nm"] / noise_sd_nm, 3) for effect in self.hidden],
                "base": self.base.describe(),
            }
        )


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
    design: str = "full",
    **design_settings: Any,
) -> Scenario:
    """A scenario with the effects `names`, each of the given strength on its own.

    Bases, forms and magnitudes are drawn until the strength's band is reached.

    Raises ValueError: unknown effect, strength or design; or no muscle found that shows the effect this strongly.
    """
    if strength not in BANDS:
        raise ValueError(f"strength {strength!r}: one of {', '.join(BANDS)}")
    effects = [(name, find_effect(name)) for name in names]
    low, high = BANDS[strength]

    def hide(name: str, effect: Effect) -> HiddenEffect:
        """The effect with this strength on this base, in one of the forms that the seed allows."""
        forms = find_forms(effect, seed)
        form = forms[int(rng.integers(len(forms)))](rng, base)
        target_nm = noise_sd_nm * float(np.exp(rng.uniform(np.log(low * 1.08), np.log(min(high, 20.0) * 0.92))))
        band_nm = noise_sd_nm * low, noise_sd_nm * high
        magnitude, excess = find_magnitude(effect.counted, form, base, sequence, target_nm, band_nm)
        return HiddenEffect(name, form, magnitude, strength, excess)

    for attempt in range(ATTEMPTS):
        rng = rng_of(seed, *names, strength, str(attempt))
        base = draw_base(rng, steep)
        if pulsed:
            base = replace(base, burst_s=float(rng.uniform(0.003, 0.012)))
        moves = moving or bool(MOVING & set(names))
        sequence = make_design(design, rng, float(base.largest_width_us), moving=moves, **design_settings)
        try:
            scenario = Scenario(base, tuple(hide(name, effect) for name, effect in effects), sequence)
            scenario.stages()  # two effects may replace the same stage
        except NotSuited:
            continue
        return scenario
    raise ValueError(f"{' and '.join(names)}, {strength}: no muscle found that shows it this strongly")


def draw_pair(rng: Generator) -> tuple[str, str]:
    """Two different effects of the library that need no movement."""
    first, second = rng.choice(len(STILL), 2, replace=False)
    return STILL[int(first)], STILL[int(second)]


def jsonable(value: Any) -> Any:
    """The value as plain numbers, lists and dictionaries."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [jsonable(v) for v in value]
    if isinstance(value, bool | str) or value is None:
        return value
    return int(value) if isinstance(value, int | np.integer) else round(float(value), 6)
