"""Straight from one width to another: a part of the recruitment curve, for tests that are extended as they play."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings, pulses_in


class Settings(SequenceSettings):
    from_pulse_width_us: float = Field(0.0, ge=0, description="first width, µs")
    to_pulse_width_us: float = Field(0.0, ge=0, description="last width, µs")
    duration_s: float = Field(1.0, gt=0, le=60, description="time from the first to the last, s")
    jumps: bool = Field(False, description="whether the first width may be any jump away from the pulse before it")


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    """Widths in µs, shape (duration × rate,); both ends are reached, a single pulse has the last width."""
    count = pulses_in(settings.duration_s, pulse_rate_hz)
    shape = np.linspace(0.0, 1.0, count) if count > 1 else np.ones(count)
    return settings.from_pulse_width_us + shape * (settings.to_pulse_width_us - settings.from_pulse_width_us)
