"""Pieces of one to two seconds of which an adaptive test is made: holds, steps, ramps and random steps between levels.

Each is a list of pulse widths, which the rig's sequence `widths` plays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from identify.experiments.designs import Segment

PIECE_S = 1.0
LONG_S = 2.0
HALF_S = 0.5
CHIP_S = 0.1
CHIPS = (1, 0, 0, 1, 1, 0, 1, 0, 1, 1)
"""Signs of a random piece: runs of different lengths, as often high as low or nearly so."""


@dataclass(frozen=True)
class Piece:
    """A candidate for the next segment.

    Parameters
    ----------
    kind : str
        hold, step, ramp or prbs.
    pulse_width_us : ndarray, shape (P,)
        One width for each pulse, µs.
    """

    kind: str
    pulse_width_us: np.ndarray

    def segment(self, number: int) -> Segment:
        """As the rig plays it."""
        widths = [float(np.floor(10.0 * u) / 10.0) for u in self.pulse_width_us]
        return Segment(f"{self.kind} {number}", "widths", {"pulse_width_us": widths, "jumps": True})


def pieces(levels_us: np.ndarray, pulse_rate_hz: float) -> list[Piece]:
    """All pieces between some levels.

    Parameters
    ----------
    levels_us : ndarray
        Levels to move between, µs, 0 among them.
    pulse_rate_hz : float
        Pulses a second.
    """
    levels = np.unique(np.round(np.floor(10.0 * levels_us) / 10.0, 1))
    one, half, two = (max(round(s * pulse_rate_hz), 2) for s in (PIECE_S, HALF_S, LONG_S))
    chip = max(round(CHIP_S * pulse_rate_hz), 1)
    found = [Piece("hold", np.full(one, level)) for level in levels]
    for first, second in permutations(levels, 2):
        found.append(Piece("step", np.repeat([first, second], half)))
        ramps = [first + (second - first) * np.arange(1, size + 1) / size for size in (one, two)]
        found += [Piece("ramp", ramp) for ramp in ramps]
        if first > second:
            found.append(Piece("prbs", np.repeat(np.where(CHIPS, first, second), chip)))
    return found
