"""A base muscle with what is hidden in it; simulated over a design; the size of an effect set by what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.chain import Chain
from hardware_sim.patients.hidden.kernels import SLOTS, Floats, Formulation, NotSuited, Stage
from hardware_sim.patients.hidden.protocol import Protocol40
from hardware_sim.patients.hidden.yardstick import Yardstick

BANDS = {"weak": (2.0, 5.0), "middle": (5.0, 10.0), "strong": (10.0, 25.0)}
"""Excess error over the noise's sd."""

EVERYWHERE = frozenset({"tremor", "mains_hum", "voluntary_effort", "clonus"})
"""Not predictable in held-out rows: their excess is the residual over the whole record."""

ADDED = frozenset({"mains_hum"})
"""Aliases at the pulse rate: the excess is the rms of what is added, at the full rate."""

EITHER = frozenset({"threshold_drift", "fatigue", "potentiation"})
"""Can hide from the held-out rows: the larger of training and held-out residual counts."""

_REPLACED = ("recruitment", "dynamics")


@dataclass(frozen=True)
class Hidden:
    """One effect: how it is written, how large it is, and how much it leaves."""

    effect: str
    formulation: Formulation
    magnitude: float
    strength: str
    excess: dict[str, float]


def combine(base: Base, hidden: list[tuple[Formulation, float]]) -> list[Stage]:
    """The base's stages with those of the effects put in.

    Raises
    ------
    NotSuited
        Two effects want the place of the same stage.
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


def simulate(
    base: Base, stages: list[Stage], design: Protocol40, step_s: float, noise_nm: Floats | None = None
) -> Floats:
    """Torque at every step of the design, N·m; the noise enters before the converter."""
    width, pulse, angle, velocity = design.fine(step_s)
    before, after = split(stages)
    torque = Chain(before, base.largest_nm, step_s).run(width, pulse, angle, velocity)
    if noise_nm is not None:
        torque = torque + noise_nm
    if after:
        torque = Chain(after, base.largest_nm, step_s).run(torque, pulse, angle, velocity)
    return torque


def excess_nm(effect: str, residual_nm: Floats, held_out: np.ndarray) -> dict[str, float]:
    """Root mean square of what the effect-free fit leaves: trained, held out, whole, and the one that counts."""
    rms = lambda rows: float(np.sqrt(np.mean(rows**2))) if rows.size else float("nan")  # noqa: E731
    out = {
        "training_nm": rms(residual_nm[~held_out]),
        "held_out_nm": rms(residual_nm[held_out]),
        "all_nm": rms(residual_nm),
    }
    if effect in EVERYWHERE or not held_out.any():
        out["counted_nm"] = out["all_nm"]
    elif effect in EITHER:
        out["counted_nm"] = max(out["training_nm"], out["held_out_nm"])
    else:
        out["counted_nm"] = out["held_out_nm"]
    return out


def set_size(
    effect: str,
    formulation: Formulation,
    base: Base,
    design: Protocol40,
    target_nm: float,
    step_s: float,
    tolerance: float = 0.06,
) -> tuple[float, dict[str, float]]:
    """Magnitude at which the effect leaves `target_nm`, by secant steps in the logarithm, within its top.

    Raises
    ------
    NotSuited
        The largest magnitude leaves less.
    """
    yardstick = Yardstick(base, design.width_us, design.held_out)
    every = round(1.0 / 40.0 / step_s)

    def residual(stages: list[Stage]) -> dict[str, float]:
        torque = simulate(base, stages, design, step_s)
        if not np.all(np.isfinite(torque)):
            raise NotSuited("the simulation diverged")
        return excess_nm(effect, yardstick.fit(torque[::every]), design.held_out)

    without = simulate(base, base.stages(), design, step_s)
    own = residual(base.stages())["counted_nm"]  # what the spline cannot follow of the base itself

    def leaves(magnitude: float) -> dict[str, float]:
        stages = combine(base, [(formulation, magnitude)])
        found = residual(stages)
        counted = float(np.sqrt(max(found["counted_nm"] ** 2 - own**2, 1e-18)))
        if effect in ADDED:
            counted = float(np.std(simulate(base, stages, design, step_s) - without))
        return found | {"counted_nm": counted}

    if own > 0.5 * target_nm:
        raise NotSuited("the yardstick cannot follow this base closely enough")
    high = formulation.top
    at_high = leaves(high)
    if at_high["counted_nm"] < target_nm:
        raise NotSuited("too small even at its top")
    low, at_low = high * 1e-3, target_nm * 1e-3
    magnitude = high * target_nm / at_high["counted_nm"]
    found = at_high
    for _ in range(12):
        found = leaves(magnitude)
        counted = found["counted_nm"]
        if abs(np.log(counted / target_nm)) < tolerance:
            return magnitude, found
        if counted > target_nm:
            high, at_high = magnitude, found
        else:
            low, at_low = magnitude, max(counted, 1e-9)
        slope = np.log(at_high["counted_nm"] / at_low) / np.log(high / low)
        step = np.log(target_nm / counted) / np.clip(slope, 0.4, 4.0)
        inside = np.clip(
            np.log(magnitude) + step, np.log(low) * 0.97 + np.log(high) * 0.03, np.log(low) * 0.03 + np.log(high) * 0.97
        )
        magnitude = float(np.exp(inside))
    raise NotSuited("the effect's size does not grow smoothly")


def band_of(excess_over_noise: float) -> str:
    """Name of the band an excess falls in."""
    for name, (low, high) in BANDS.items():
        if low <= excess_over_noise < high:
            return name
    return "below" if excess_over_noise < BANDS["weak"][0] else "above"


def jsonable(value: Any) -> Any:
    """Plain numbers for `reveal`."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [jsonable(v) for v in value]
    if isinstance(value, bool | str) or value is None:
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    return round(float(value), 6)
