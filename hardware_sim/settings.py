"""The emulator's settings, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hardware_sim.errors import SettingsError

RANGES = {
    "noise_nm": (0.0, 10.0),
    "torque_offset_nm": (-50.0, 50.0),
    "rate_hz": (10.0, 10000.0),
    "speed": (0.01, 100.0),
    "clock_ppm": (-10000.0, 10000.0),
    "clock_jitter_us": (0.0, 100000.0),
}


@dataclass(frozen=True)
class Settings:
    """How the emulated rig is set up; each number's range is in `RANGES`."""

    patient: str = "paper"
    stimulator: str = "p24"
    cell: str = "plain"
    transport: str = "socketcand"
    noise_nm: float = 0.05
    noise_seed: int = 0
    torque_offset_nm: float = 0.0
    rate_hz: float = 1600.0
    speed: float = 1.0
    clock_ppm: float = 0.0
    clock_jitter_us: float = 0.0
    samples_per_frame: int = 1
    sync: bool = True

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                option = "--" + name.replace("_", "-")
                raise SettingsError(f"{option} must be between {low:g} and {high:g}, not {value:g}")
