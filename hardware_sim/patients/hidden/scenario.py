"""A base muscle with what is hidden in it; simulated over a design; the size of an effect set by what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware_sim.patients.hidden.base import Base
from hardware_sim.patients.hidden.chain import Chain
from hardware_sim.patients.hidden.kernels import SLOTS, Floats, Formulation, NotSuited, Stage
from hardware_sim.patients.hidden.protocol import Protocol40
from hardware_sim.patients.hidden.yardstick import PULSE_RATE_HZ, Yardstick

BANDS = {"weak": (2.0, 5.0), "middle": (5.0, 10.0), "strong": (10.0, 25.0)}
"""Excess error over the noise's sd."""

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
"""Not predictable in held-out rows: their excess is the residual over the whole record."""

ADDED = frozenset({"mains_hum"})
"""Aliases at the pulse rate: the excess is the rms of what is added, at the full rate."""

EITHER = frozenset({"threshold_drift", "fatigue", "potentiation"})
"""Can hide from the held-out rows: the larger of training and held-out residual counts."""

IN_TRAINING = frozenset({"slipped_electrode"})
"""Happens while training: what it leaves there counts, since only there it can be seen to happen."""

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
    elif effect in IN_TRAINING:
        out["counted_nm"] = out["training_nm"]
    elif effect in EITHER:
        out["counted_nm"] = max(out["training_nm"], out["held_out_nm"])
    else:
        out["counted_nm"] = out["held_out_nm"]
    return out


@dataclass
class _Sizing:
    """What an effect of a given magnitude leaves on one base and one design."""

    effect: str
    formulation: Formulation
    base: Base
    design: Protocol40
    step_s: float

    def __post_init__(self) -> None:
        self._yardstick = Yardstick(self.base, self.design.width_us, self.design.held_out)
        self._without, found = self._residual(self.base.stages())
        self.own_nm = found["counted_nm"]  # what the spline cannot follow of the base itself

    def _residual(self, stages: list[Stage]) -> tuple[Floats, dict[str, float]]:
        torque = simulate(self.base, stages, self.design, self.step_s)
        if not np.all(np.isfinite(torque)):
            raise NotSuited("the simulation diverged")
        every = round(1.0 / PULSE_RATE_HZ / self.step_s)
        return torque, excess_nm(self.effect, self._yardstick.fit(torque[::every]), self.design.held_out)

    def leaves(self, magnitude: float) -> dict[str, float]:
        """Excess in N·m; `counted_nm` is freed of the base's own."""
        torque, found = self._residual(combine(self.base, [(self.formulation, magnitude)]))
        counted = float(np.sqrt(max(found["counted_nm"] ** 2 - self.own_nm**2, 1e-18)))
        if self.effect in ADDED:
            counted = float(np.std(torque - self._without))
        return found | {"counted_nm": counted}


def set_size(
    effect: str,
    formulation: Formulation,
    base: Base,
    design: Protocol40,
    target_nm: float,
    band_nm: tuple[float, float],
    step_s: float,
) -> tuple[float, dict[str, float]]:
    """Magnitude at which the effect leaves about `target_nm`, and what it leaves, surely within the band.

    Secant steps in the logarithm, kept within a bracket.

    Raises
    ------
    NotSuited
        The largest magnitude leaves less, or the base itself too much.
    """
    sizing = _Sizing(effect, formulation, base, design, step_s)
    if sizing.own_nm > 0.5 * target_nm:
        raise NotSuited("the yardstick cannot follow this base closely enough")
    high = formulation.top
    at_high = sizing.leaves(high)["counted_nm"]
    if at_high < target_nm:
        raise NotSuited("too small even at its top")
    low, at_low = high * 1e-3, target_nm * 1e-3
    magnitude = high * target_nm / at_high
    for tries in range(12):
        found = sizing.leaves(magnitude)
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
