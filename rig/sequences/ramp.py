"""Triangular ramp 0 → c → 0: covers the whole recruitment curve slowly, up and down (paper, section III-B)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings, pulses_in


class Settings(SequenceSettings):
    max_pulse_width_us: float = Field(300.0, description="top of the ramp c, µs")
    up_s: float = Field(5.0, gt=0, le=120, description="time from 0 to c, s")
    down_s: float = Field(5.0, gt=0, le=120, description="time from c to 0, s")


def pulse_count(settings: Settings, pulse_rate_hz: float) -> int:
    return pulses_in(settings.up_s, pulse_rate_hz) + pulses_in(settings.down_s, pulse_rate_hz)


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    """Widths in µs, shape ((up + down) × rate,); the top is reached with the last pulse of the rise."""
    up = pulses_in(settings.up_s, pulse_rate_hz)
    down = pulses_in(settings.down_s, pulse_rate_hz)
    if up < 1 or down < 1:
        raise ValueError("up_s and down_s must each hold at least one pulse; lengthen them")
    shape = np.concatenate([np.arange(1, up + 1) / up, np.arange(down - 1, -1, -1) / down])
    return shape * settings.max_pulse_width_us
