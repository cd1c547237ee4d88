"""Pieces of an adaptive test of several muscles: 1.3 to 3 s after the opening, one muscle alone or all at once.

Each is a list of pulse widths for each channel, which the rig's sequence `widths` plays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.identify.experiments.designs import CHIPS

REST_S, RISE_S, TOP_S, FALL_S = 0.5, 1.0, 0.2, 0.8
"""The opening: rest; of each muscle in turn a ramp to its largest width, a while there, silence; then levels of all."""
BOTH_S, SILENCE_S = 2.5, 0.5
"""Levels of all muscles, and the silence at the end of a piece."""
HOLDS_S = 0.15, 0.6
"""Shortest and longest time that a level is held."""
STAIR_S, BURST_S, GAP_S = 0.4, 0.2, 0.4
SLOW_S, FAST_S = 1.6, 0.6
CHIP_S = 0.1
DRAWN = 6
"""Pieces of each random kind."""


@dataclass(frozen=True)
class Piece:
    """A candidate for the next segment."""

    kind: str
    pulse_width_us: np.ndarray  # one for each pulse of each channel, shape (P, C)

    def segment(self, number: int, names: Sequence[str]) -> dict[str, Any]:
        """As the rig plays it: a segment with a sequence for each channel."""
        channels = {
            name: {"sequence": "widths", "settings": {"pulse_width_us": own.tolist(), "jumps": True}}
            for name, own in zip(names, self.pulse_width_us.T, strict=True)
        }
        first = channels[names[0]]
        return {"name": f"{self.kind} {number}", **first, "channels": channels}


def _piece(kind: str, columns: Sequence[np.ndarray]) -> Piece:
    """Of columns of any length, each silent after its end; widths rounded down as the rig takes them."""
    size = max(one.size for one in columns)
    widths = np.stack([np.pad(one, (0, size - one.size)) for one in columns], axis=1)
    return Piece(kind, np.floor(10.0 * widths + 1e-6) / 10.0)


class Pieces:
    """All pieces between some levels of each channel.

    Parameters
    ----------
    levels_us : sequence of array
        Of each channel, above 0, in order, µs.
    pulse_rate_hz : float
    seed : int
        Of the random pieces; another one for each decision, or a test would play the same levels again and again.
    """

    def __init__(self, levels_us: Sequence[np.ndarray], pulse_rate_hz: float, seed: int) -> None:
        self.levels, self.rate = [np.unique(one) for one in levels_us], pulse_rate_hz
        self.rng = np.random.default_rng([seed, len(levels_us)])

    def pulses(self, seconds: float) -> int:
        return max(round(seconds * self.rate), 1)

    def silence(self) -> np.ndarray:
        return np.zeros(self.pulses(SILENCE_S))

    def opening(self) -> Piece:
        """A first look at each muscle alone, then at all."""
        turns, before = [], np.zeros(self.pulses(REST_S))
        for own in self.levels:
            up = own[-1] * np.arange(1, self.pulses(RISE_S) + 1) / self.pulses(RISE_S)
            turns.append(np.r_[up, np.full(self.pulses(TOP_S), own[-1]), np.zeros(self.pulses(FALL_S))])
        columns = []
        for place in range(len(turns)):
            alone = [turn if place == i else np.zeros(turn.size) for i, turn in enumerate(turns)]
            columns.append(np.r_[before, np.concatenate(alone), self.held(place, BOTH_S), self.silence()])
        return _piece("opening", columns)

    def candidates(self) -> list[Piece]:
        """Pieces of each muscle alone, and of all."""
        channels = range(len(self.levels))
        found = [_piece(kind, self.alone(place, own)) for place in channels for kind, own in self.own(place)]
        for _ in range(DRAWN):
            found.append(_piece("levels", [np.r_[self.held(place, BOTH_S), self.silence()] for place in channels]))
            found.append(_piece("bursts", [self.bursts(place) for place in channels]))
            found.append(_piece("prbs", [np.r_[self.chips(place), self.silence()] for place in channels]))
        for first in channels:
            columns = [self.ramp(place, FAST_S if place == first else SLOW_S) for place in channels]
            found.append(_piece("ramps", columns))
        return found

    def alone(self, place: int, own: np.ndarray) -> list[np.ndarray]:
        return [own if place == i else np.zeros(own.size) for i in range(len(self.levels))]

    def own(self, place: int) -> list[tuple[str, np.ndarray]]:
        """Of one muscle alone."""
        found = [("ramp", self.ramp(place, seconds)) for seconds in (FAST_S, SLOW_S)]
        for _ in range(DRAWN):
            stairs = np.repeat(self.rng.permutation(self.levels[place])[:4], self.pulses(STAIR_S))
            found += [("stairs", np.r_[stairs, self.silence()]), ("burst", self.bursts(place))]
        return found

    def ramp(self, place: int, rise_s: float) -> np.ndarray:
        """Up to the largest width, and down in the rest of two ramps' time."""
        up, down = self.pulses(rise_s), self.pulses(SLOW_S + FAST_S - rise_s)
        shape = np.r_[np.arange(1, up + 1) / up, np.arange(down - 1, -1, -1) / down]
        return np.r_[self.levels[place][-1] * shape, self.silence()]

    def held(self, place: int, seconds: float) -> np.ndarray:
        """Random levels, 0 among them, each held for a while."""
        size, found = self.pulses(seconds), np.zeros(0)
        while found.size < size:
            level = self.rng.choice(np.r_[0.0, self.levels[place]])
            found = np.r_[found, np.full(self.pulses(self.rng.uniform(*HOLDS_S)), level)]
        return found[:size]

    def bursts(self, place: int) -> np.ndarray:
        """A pair of bursts, after a wait of its own: they cost little."""
        gap = np.zeros(self.pulses(GAP_S))
        wait = np.zeros(self.pulses(self.rng.uniform(0.0, GAP_S)))
        one, two = (np.full(self.pulses(BURST_S), level) for level in self.rng.choice(self.levels[place], 2))
        return np.r_[wait, one, gap, two, self.silence()]

    def chips(self, place: int) -> np.ndarray:
        """Fast changes between two levels, begun anywhere in their order."""
        low, high = np.sort(self.rng.choice(np.r_[0.0, self.levels[place]], 2, replace=False))
        order = np.roll(np.tile(CHIPS, 2), self.rng.integers(len(CHIPS)))
        return np.repeat(np.where(order, high, low), self.pulses(CHIP_S))
