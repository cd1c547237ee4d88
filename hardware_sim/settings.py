"""The emulator's settings, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stimrig.hardware_sim.errors import SettingsError

RANGES = {
    "noise_nm": (0.0, 10.0),
    "torque_offset_nm": (-50.0, 50.0),
    "rate_hz": (10.0, 10000.0),
    "speed": (0.01, 100.0),
    "clock_ppm": (-10000.0, 10000.0),
    "clock_jitter_us": (0.0, 100000.0),
    "angle_rate_hz": (10.0, 2000.0),
    "angle_bits": (8, 20),
    "angle_noise_deg": (0.0, 10.0),
    "angle_offset_deg": (-150.0, 150.0),
    "angle_scale": (0.1, 10.0),
    "angle_clock_ppm": (-10000.0, 10000.0),
    "angle_jitter_us": (0.0, 100000.0),
}
ANGLES = ("own", "in-cell")


@dataclass(frozen=True)
class Settings:
    """How the emulated rig is set up; each number's range is in `RANGES`.

    What begins with `angle` is of the joint's sensor, which is there where the rig has an arm.
    """

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
    angle: str = "own"
    angle_rate_hz: float = 200.0
    angle_bits: int = 13
    angle_noise_deg: float = 0.02
    angle_offset_deg: float = 0.0
    angle_direction: int = 1
    angle_scale: float = 1.0
    angle_clock_ppm: float = 0.0
    angle_jitter_us: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                option = "--" + name.replace("_", "-")
                raise SettingsError(f"{option} must be between {low:g} and {high:g}, not {value:g}")
