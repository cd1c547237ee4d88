"""Random levels, held for random times: tests a model on an input unlike PRBS and ramp.

The levels are stratified (one from each of n equal bands, in random order), so that a short sequence covers the whole
range. Some are zero, so that the muscle also relaxes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stimrig.rig.sequences import SequenceSettings, pulses_in

JUMPS = True


class Settings(SequenceSettings):
    max_pulse_width_us: float = Field(300.0, description="highest level c, µs")
    min_pulse_width_us: float = Field(0.0, ge=0, description="lowest level that is not zero, µs")
    min_share: float = Field(0.0, ge=0, le=1, description="the same as a share of c; the higher of both counts")
    duration_s: float = Field(7.0, gt=0, le=600, description="length, s")
    min_hold_s: float = Field(0.3, gt=0, le=600, description="shortest time on a level, s")
    max_hold_s: float = Field(1.0, gt=0, le=600, description="longest time on a level, s")
    zero_share: float = Field(0.15, ge=0, lt=1, description="share of the levels that are zero")
    seed: int = Field(20, ge=0, description="of the random numbers")

    @model_validator(mode="after")
    def _ordered(self) -> Settings:
        if not self.min_hold_s <= self.max_hold_s:
            raise ValueError("min_hold_s must not exceed max_hold_s")
        return self


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(settings.seed)
    total = pulses_in(settings.duration_s, pulse_rate_hz)
    shortest = max(1, pulses_in(settings.min_hold_s, pulse_rate_hz))
    longest = max(shortest, pulses_in(settings.max_hold_s, pulse_rate_hz))
    hold_pulses: list[int] = []
    total_pulses = 0
    while total_pulses < total:
        hold_pulses.append(int(rng.integers(shortest, longest + 1)))
        total_pulses += hold_pulses[-1]
    n_zero = round(settings.zero_share * len(hold_pulses))
    n_levels = len(hold_pulses) - n_zero
    bands = (rng.permutation(n_levels) + rng.random(n_levels)) / max(n_levels, 1)
    lowest_us = max(settings.min_pulse_width_us, settings.min_share * settings.max_pulse_width_us)
    span_us = settings.max_pulse_width_us - lowest_us
    levels_us = rng.permutation(np.concatenate([lowest_us + bands * span_us, np.zeros(n_zero)]))
    return np.repeat(levels_us, hold_pulses)[:total]
