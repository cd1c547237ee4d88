"""Pseudo-random binary sequence between 0 and c, from a maximum-length shift register.

With only two levels the response is linear in the input, whatever the shape of the recruitment curve. So the linear
dynamics can be identified from it alone (paper, section III-A, after Godfrey 1993).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings

JUMPS = True

FEEDBACK_TAPS = {
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 11, 10, 4),
}
"""Primitive feedback polynomials over GF(2): the register passes through all 2^bits − 1 non-zero states."""


class Settings(SequenceSettings):
    max_pulse_width_us: float = Field(300.0, description="upper level c, µs; the lower is 0")
    bits: int = Field(7, ge=3, le=12, description="length of the shift register: the period is 2^bits − 1 chips")
    clock_pulses: int = Field(4, ge=1, le=200, description="pulses for which each chip is held")
    chips: int | None = Field(None, ge=1, le=100_000, description="chips to play; None: one whole period")
    seed: int = Field(1, ge=0, description="where in its period the register starts")


def shift_register(bits: int, chips: int, seed: int = 1) -> NDArray[np.uint8]:
    """`chips` bits of the maximum-length sequence, starting from state `seed` (any, folded into 1 … 2^bits − 1)."""
    taps = FEEDBACK_TAPS[bits]
    state = (seed - 1) % (2**bits - 1) + 1
    out = np.empty(chips, dtype=np.uint8)
    for i in range(chips):
        out[i] = state >> (bits - 1) & 1
        feedback = 0
        for tap in taps:
            feedback ^= state >> (tap - 1) & 1
        state = (state << 1 | feedback) & (2**bits - 1)
    return out


def pulse_count(settings: Settings, pulse_rate_hz: float) -> int:
    del pulse_rate_hz
    return (settings.chips or 2**settings.bits - 1) * settings.clock_pulses


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    """0 or c in µs, shape (chips × clock_pulses,); the clock is in pulses, so the rate sets only its seconds."""
    del pulse_rate_hz
    chips = settings.chips or 2**settings.bits - 1
    bits = shift_register(settings.bits, chips, settings.seed)
    return np.repeat(bits.astype(np.float64) * settings.max_pulse_width_us, settings.clock_pulses)
