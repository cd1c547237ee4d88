"""The train of a test: all its slots, which channel each belongs to, and when it is due. Pure.

With C channels slot i is pulse i // C of channel i % C, due (i // C) / pulse_rate_hz + that channel's offset after the
start. A round is one slot of each channel; whatever is laid consists of whole rounds. With one channel a slot is a
pulse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Index = TypeVar("Index", int, NDArray[np.int64])


@dataclass(frozen=True, slots=True)
class Train:
    """The pace: pulses per second of each channel, and how much later than the first channel's its pulses come, s."""

    pulse_rate_hz: float
    offsets_s: tuple[float, ...] = (0.0,)

    @property
    def channels(self) -> int:
        """How many it has."""
        return len(self.offsets_s)

    @property
    def slots_per_s(self) -> float:
        return self.pulse_rate_hz * self.channels

    def channel(self, slot: Index) -> Index:
        return slot % self.channels

    def due_s(self, slot: int) -> float:
        """When a slot is due on the test's clock, s."""
        pulse, channel = divmod(slot, self.channels)
        return pulse / self.pulse_rate_hz + self.offsets_s[channel]

    def due_times_s(self, slots: int) -> NDArray[np.float64]:
        """When each of the first slots is due, shape (slots,), s."""
        pulse, channel = np.divmod(np.arange(slots), self.channels)
        return pulse / self.pulse_rate_hz + np.array(self.offsets_s)[channel]

    def length_s(self, slots: int) -> float:
        """How long so many slots last, s; of whole rounds the time at which the next one begins."""
        return slots / self.slots_per_s

    def slots(self, duration_s: float) -> int:
        """Slots in a duration, to the nearest round."""
        return round(duration_s * self.pulse_rate_hz) * self.channels

    def whole(self, slots: int) -> int:
        """That many slots, up to the end of a round."""
        return -(-slots // self.channels) * self.channels

    def gap_s(self, channel: int) -> float:
        """From a channel's slot to the next slot of any channel, s."""
        after = (*self.offsets_s, 1 / self.pulse_rate_hz)
        return after[channel + 1] - after[channel]


def train_of(pulse_rate_hz: float, offsets_s: Sequence[float | None] = (0.0,)) -> Train:
    """The train of channels with these offsets; None: its share of the pulse period."""
    count = len(offsets_s)
    shares_s = (place / (count * pulse_rate_hz) for place in range(count))
    return Train(pulse_rate_hz, tuple(a if o is None else o for a, o in zip(shares_s, offsets_s, strict=True)))
