"""A list of pulse widths, one for each pulse, for sequences made by other tools."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings

MAX_PULSES = 18_000
"""Pulses of the longest test (300 s) at the highest rate (60 Hz): `stimrig.rig.limits` allows no more."""


class Settings(SequenceSettings):
    pulse_width_us: list[float] = Field(min_length=1, max_length=MAX_PULSES, description="µs, one for each pulse")
    jumps: bool = Field(False, description="whether the list jumps between levels on purpose, as a PRBS does")


def pulse_count(settings: Settings, pulse_rate_hz: float) -> int:
    del pulse_rate_hz
    return len(settings.pulse_width_us)


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    del pulse_rate_hz
    return np.asarray(settings.pulse_width_us, dtype=np.float64)
