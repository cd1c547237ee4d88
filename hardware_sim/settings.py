"""The emulator's settings, checked; each number with its range and what the command line says of it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from stimrig.hardware_sim.errors import HardwareSimError


def number(default: float, span: tuple[float, float] | None, metavar: str, what: str) -> Any:
    """A number of the settings, from the first to the second of `span`."""
    return option(default, span, type=type(default), metavar=metavar, help=f"{what} (default: %(default)g)")


def option(value: Any, span: tuple[float, float] | None = None, **arguments: Any) -> Any:
    """A setting with an option of the command line, and the arguments of that."""
    return field(default=value, metadata={"span": span, "option": {"default": value} | arguments})


@dataclass(frozen=True)
class Settings:
    """Settings of the emulated rig.

    Names that begin with `angle` are of the joint's sensor, which a rig with an arm has. The cell decides which
    `samples_per_frame` it takes.
    """

    patient: str = "paper"
    stimulator: str = "p24"
    cell: str = "plain"
    transport: str = "socketcand"
    noise_nm: float = number(0.05, (0.0, 10.0), "SD", "standard deviation of the sensor's white noise, N·m")
    noise_seed: int = option(0, default=None, type=int, metavar="SEED", help="of noise and faults (default: at random)")
    torque_offset_nm: float = number(0.0, (-50.0, 50.0), "NM", "the cell's zero offset")
    rate_hz: float = number(1600.0, (10.0, 10000.0), "HZ", "samples per second")
    samples_per_frame: int = number(
        1,
        None,
        "N",
        "samples in each frame: plain takes 1 or 3 (16-bit counts of 2 mN·m and a counter of frames), "
        "counts takes 1 to 4",
    )
    clock_ppm: float = number(0.0, (-10000.0, 10000.0), "PPM", "drift of the cell's clock")
    clock_jitter_us: float = number(
        0.0, (0.0, 100000.0), "SD", "standard deviation of each sample's own time, never more than 0.45 of a period"
    )
    speed: float = option(
        1.0, (0.01, 100.0), type=float, metavar="FACTOR", help="let time run FACTOR times faster, for tests"
    )
    sync: bool = True
    angle: str = option(
        "own",
        choices=("own", "in-cell"),
        help="the angle in frames of its own (id 0x182) or in the load cell's frame (default: %(default)s)",
    )
    angle_rate_hz: float = number(200.0, (10.0, 2000.0), "HZ", "frames per second of its own")
    angle_bits: int = number(13, (8, 20), "BITS", "resolution of the encoder, bits per turn")
    angle_noise_deg: float = number(0.02, (0.0, 10.0), "SD", "standard deviation of its white noise, degrees")
    angle_offset_deg: float = number(0.0, (-150.0, 150.0), "DEG", "its reading at the straight arm")
    angle_scale: float = number(1.0, (0.1, 10.0), "FACTOR", "true angle = direction × FACTOR × (reading − offset)")
    angle_clock_ppm: float = number(0.0, (-10000.0, 10000.0), "PPM", "drift of its clock")
    angle_jitter_us: float = number(0.0, (0.0, 100000.0), "SD", "standard deviation of each of its samples' own time")
    angle_direction: int = option(1, type=int, choices=(1, -1), help="-1: its readings fall in flexion (default: 1)")

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value, span = getattr(self, each.name), each.metadata.get("span")
            if span and not (math.isfinite(value) and span[0] <= value <= span[1]):
                option = "--" + each.name.replace("_", "-")
                raise HardwareSimError(f"{option} must be between {span[0]:g} and {span[1]:g}, not {value:g}")
