"""The electrodes: which pulses were fired, which reached the muscle, and the sync line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stimrig.hardware_sim.patients.muscle import Muscle

Point = tuple[int, float]
"""One piece of a pulse's shape: duration in µs, current in mA."""


@dataclass(frozen=True)
class FiredPulse:
    """A pulse that the stimulator fired, as the muscle sees it: one phase's width and current."""

    time_s: float
    width_us: float
    current_ma: float
    delivered: bool
    balanced: bool
    source: str


class Electrodes:
    """One pair on one muscle, at one of the stimulator's outputs.

    `raise_sync` is called for each pulse that flows. `cut` is the emergency switch: some devices report it, to the
    others it looks like an open electrode.
    """

    def __init__(self, muscle: Muscle, raise_sync: Callable[[], None] = lambda: None) -> None:
        self.attached = True
        self.cut = False
        self.output = (0, 0)
        self.unbalanced_pulses = 0
        self.delivered_pulses = 0
        self.log: list[FiredPulse] = []
        self._muscle = muscle
        self._raise_sync = raise_sync

    def closed_circuit(self, output: tuple[int, int]) -> bool:
        """Whether current can flow at this (connector, channel)."""
        return self.attached and not self.cut and output == self.output

    def fire(self, time_s: float, points: Sequence[Point], output: tuple[int, int], source: str) -> bool:
        """One pulse of this shape; True if it flowed through the muscle."""
        width_us, current_ma, balanced = phase(points)
        flows = self.closed_circuit(output) and width_us > 0
        self.log.append(FiredPulse(time_s, width_us, current_ma, flows, balanced, source))
        if not balanced:
            self.unbalanced_pulses += 1
        if flows:
            self.delivered_pulses += 1
            self._muscle.pulse(time_s, width_us, current_ma)
            self._raise_sync()
        return flows

    def pulses(self, since: int = 0) -> list[dict[str, Any]]:
        """The log from entry `since` on, as plain values."""
        return [asdict(pulse) for pulse in self.log[since:]]


def phase(points: Sequence[Point]) -> tuple[float, float, bool]:
    """Width (µs) and mean current (mA) of a shape's positive phase, and whether its charge sums to zero.

    The negative phase counts if there is no positive one: nerves respond to both.
    """
    net_us_ma = sum(width * current for width, current in points)
    for sign in (1, -1):
        width_us = sum(width for width, current in points if sign * current > 0)
        if width_us > 0:
            charge = sum(width * abs(current) for width, current in points if sign * current > 0)
            return float(width_us), charge / width_us, net_us_ma == 0
    return 0.0, 0.0, True
