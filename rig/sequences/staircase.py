"""Staircase 0 → c → 0 in equal steps: shows the steady torque at each level, up and down."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings, pulses_in

JUMPS = True


class Settings(SequenceSettings):
    max_pulse_width_us: float = Field(300.0, description="highest step c, µs")
    levels: int = Field(6, ge=1, le=100, description="steps from 0 up to c")
    hold_s: float = Field(1.0, gt=0, le=60, description="time on each step, s")
    down: bool = Field(True, description="come down by the same steps")


def pulse_count(settings: Settings, pulse_rate_hz: float) -> int:
    steps = 2 * settings.levels if settings.down else settings.levels
    return steps * pulses_in(settings.hold_s, pulse_rate_hz)


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    up = np.arange(1, settings.levels + 1) / settings.levels
    shape = np.concatenate([up, up[-2::-1], [0.0]]) if settings.down else up
    return np.repeat(shape * settings.max_pulse_width_us, pulses_in(settings.hold_s, pulse_rate_hz))
