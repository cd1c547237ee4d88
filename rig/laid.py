"""Everything that is laid out to be played: the pulses of a test so far, and the segments that they make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig import journal as jn
from rig.pieces import Piece


@dataclass(frozen=True, slots=True)
class Laid:
    """Everything that is laid: widths in µs and whether each may jump there, shape (n,), and the segments."""

    pulse_width_us: NDArray[np.float64]
    jumps: NDArray[np.bool_]
    segments: tuple[jn.Segment, ...]

    def __len__(self) -> int:
        return len(self.pulse_width_us)

    def cut(self, end: int) -> Laid:
        """The part before pulse `end`."""
        kept = (s._replace(end=min(s.end, end)) for s in self.segments if s.start < end)
        return Laid(self.pulse_width_us[:end], self.jumps[:end], tuple(kept))

    def with_piece(self, piece: Piece, by: jn.LaidBy) -> Laid:
        """It, and a piece after it."""
        end = len(self) + len(piece.pulse_width_us)
        added = jn.Segment(piece.of.name, len(self), end, by)
        return Laid(
            np.concatenate([self.pulse_width_us, piece.pulse_width_us]),
            np.concatenate([self.jumps, np.full(len(piece.pulse_width_us), piece.jumps)]),
            (*self.segments, added),
        )
