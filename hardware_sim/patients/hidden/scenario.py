"""Simulating a base muscle with hidden effects, and finding the magnitude at which an effect shows as asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.chain import Chain
from stimrig.hardware_sim.patients.hidden.design import Design
from stimrig.hardware_sim.patients.hidden.effect_free_fit import PULSE_RATE_HZ, EffectFreeFit
from stimrig.hardware_sim.patients.hidden.kernels import SLOTS, Floats, Formulation, NotSuited, Stage

BANDS = {"weak": (2.0, 5.0), "middle": (5.0, 10.0), "strong": (10.0, 25.0)}
"""Excess error over the noise's standard deviation."""

EVERYWHERE = frozenset(
    {
        "tremor",
        "voluntary_effort",
        "clonus",
        "gain_jumps",
        "delay_jitter",
        "loose_contact",
        "sensor_gain_swing",
    }
)
"""Not predictable in held-out rows: the residual over the whole record counts."""

ADDED = frozenset({"mains_hum"})
"""Aliases at the pulse rate: the rms of the added torque at the full rate counts."""

EITHER = frozenset({"threshold_drift", "fatigue", "potentiation"})
"""May not show in the held-out rows: the larger of training and held-out residual counts."""

IN_TRAINING = frozenset({"slipped_electrode"})
"""Happens in the training rows only: the training residual counts."""

_REPLACED = ("recruitment", "dynamics")


@dataclass(frozen=True)
class HiddenEffect:
    """One effect: its formulation, its magnitude, and the error that a fit without it leaves."""

    effect: str
    formulation: Formulation
    magnitude: float
    strength: str
    excess: dict[str, float]


def combine(base: Base, hidden: list[tuple[Formulation, float]]) -> list[Stage]:
    """The base's stages together with those of the effects.

    Raises
    ------
    NotSuited
        Two effects replace the same stage.
    """
    stages = [stage for formulation, magnitude in hidden for stage in formulation.build(magnitude)]
    taken = [stage.slot for stage in stages if stage.slot in _REPLACED]
    if len(set(taken)) < len(taken):
        raise NotSuited("both effects replace the same stage")
    return [stage for stage in base.stages() if stage.slot not in taken] + stages


def split(stages: list[Stage]) -> tuple[list[Stage], list[Stage]]:
    """Stages before and after the measurement noise."""
    cut = SLOTS.index("converter")
    return [s for s in stages if SLOTS.index(s.slot) < cut], [s for s in stages if SLOTS.index(s.slot) >= cut]


def simulate(base: Base, stages: list[Stage], design: Design, step_s: float, noise_nm: Floats | None = None) -> Floats:
    """Torque at every step of the design, N·m; the noise is added before the converter."""
    width, pulse, angle, velocity = design.fine(step_s)
    before, after = split(stages)
    torque = Chain(before, base.largest_nm, step_s).run(width, pulse, angle, velocity)
    if noise_nm is not None:
        torque = torque + noise_nm
    if after:
        torque = Chain(after, base.largest_nm, step_s).run(torque, pulse, angle, velocity)
    return torque


def excess_nm(effect: str, residual_nm: Floats, held_out: np.ndarray) -> dict[str, float]:
    """Root mean squares of the residual: training rows, held-out rows, all rows, and the one that counts."""
    rms = lambda rows: float(np.sqrt(np.mean(rows**2))) if rows.size else float("nan")  # noqa: E731
    out = {
        "training_nm": rms(residual_nm[~held_out]),
        "held_out_nm": rms(residual_nm[held_out]),
        "all_nm": rms(residual_nm),
    }
    if effect in EVERYWHERE or not held_out.any():
        out["counted_nm"] = out["all_nm"]
    elif effect in IN_TRAINING:
        out["counted_nm"] = out["training_nm"]
    elif effect in EITHER:
        out["counted_nm"] = max(out["training_nm"], out["held_out_nm"])
    else:
        out["counted_nm"] = out["held_out_nm"]
    return out


@dataclass
class _Excess:
    """The error that the effect-free fit leaves, by the effect's magnitude, on one base and one design."""

    effect: str
    formulation: Formulation
    base: Base
    design: Design
    step_s: float

    def __post_init__(self) -> None:
        self._effect_free_fit = EffectFreeFit(self.base, self.design.width_us, self.design.held_out)
        self._without, found = self._residual(self.base.stages())
        self.own_nm = found["counted_nm"]  # what the fit leaves without any effect

    def _residual(self, stages: list[Stage]) -> tuple[Floats, dict[str, float]]:
        torque = simulate(self.base, stages, self.design, self.step_s)
        if not np.all(np.isfinite(torque)):
            raise NotSuited("the simulation diverged")
        every = round(1.0 / PULSE_RATE_HZ / self.step_s)
        return torque, excess_nm(self.effect, self._effect_free_fit.fit(torque[::every]), self.design.held_out)

    def at(self, magnitude: float) -> dict[str, float]:
        """Excess in N·m; the error without the effect is taken out of `counted_nm`."""
        torque, found = self._residual(combine(self.base, [(self.formulation, magnitude)]))
        counted = float(np.sqrt(max(found["counted_nm"] ** 2 - self.own_nm**2, 1e-18)))
        if self.effect in ADDED:
            counted = float(np.std(torque - self._without))
        return found | {"counted_nm": counted}


def find_magnitude(
    effect: str,
    formulation: Formulation,
    base: Base,
    design: Design,
    target_nm: float,
    band_nm: tuple[float, float],
    step_s: float,
) -> tuple[float, dict[str, float]]:
    """Magnitude at which the excess is about `target_nm` and within the band, and that excess.

    By secant steps in the logarithm, kept within a bracket.

    Raises
    ------
    NotSuited
        The excess of the largest magnitude is too small, or the fit without the effect too poor.
    """
    excess = _Excess(effect, formulation, base, design, step_s)
    if excess.own_nm > 0.5 * target_nm:
        raise NotSuited("the effect-free fit follows this base too poorly")
    high = formulation.largest_magnitude
    at_high = excess.at(high)["counted_nm"]
    if at_high < target_nm:
        raise NotSuited("too small even at its largest magnitude")
    low, at_low = high * 1e-3, target_nm * 1e-3
    magnitude = high * target_nm / at_high
    for tries in range(12):
        found = excess.at(magnitude)
        counted = found["counted_nm"]
        close = abs(np.log(counted / target_nm)) < (0.1 if tries < 6 else 1.0)
        if close and band_nm[0] * 1.03 < counted < band_nm[1] * 0.97:
            return magnitude, found
        if counted > target_nm:
            high, at_high = magnitude, counted
        else:
            low, at_low = magnitude, max(counted, 1e-9)
        slope = np.log(at_high / at_low) / np.log(high / low)
        step = np.log(target_nm / counted) / np.clip(slope, 0.4, 4.0)
        edge = 0.03 * np.log(high / low)
        magnitude = float(np.exp(np.clip(np.log(magnitude) + step, np.log(low) + edge, np.log(high) - edge)))
    raise NotSuited("the effect's size does not grow smoothly")


def jsonable(value: Any) -> Any:
    """The value as plain numbers, lists and dictionaries."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [jsonable(v) for v in value]
    if isinstance(value, bool | str) or value is None:
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    return round(float(value), 6)
