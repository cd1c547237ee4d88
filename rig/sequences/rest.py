"""Rest: no pulses. Shows the offset and noise of the torque, and lets the muscle relax."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stimrig.rig.sequences import SequenceSettings, pulses_in


class Settings(SequenceSettings):
    duration_s: float = Field(2.0, gt=0, le=600, description="length, s")


def pulse_widths(settings: Settings, pulse_rate_hz: float) -> NDArray[np.float64]:
    return np.zeros(pulses_in(settings.duration_s, pulse_rate_hz))
