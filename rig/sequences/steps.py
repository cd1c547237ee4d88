"""Repeated on-off steps at one level: show rise time, fall time and fatigue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings, pulses_in

JUMPS = True


class Settings(SequenceSettings):
    max_pulse_width_us: float = Field(300.0, description="level while on, µs")
    on_s: float = Field(1.0, gt=0, le=120, description="time on, s")
    off_s: float = Field(1.5, ge=0, le=120, description="time off, s")
    repeats: int = Field(3, ge=1, le=1000, description="number of steps")


def pulse_count(settings: Settings, pulse_rate_hz: float) -> int:
    on, off = pulses_in(settings.on_s, pulse_rate_hz), pulses_in(settings.off_s, pulse_rate_hz)
    return settings.repeats * (on + off)


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    on = np.full(pulses_in(settings.on_s, pulse_rate_hz), settings.max_pulse_width_us)
    off = np.zeros(pulses_in(settings.off_s, pulse_rate_hz))
    return np.tile(np.concatenate([on, off]), settings.repeats)
