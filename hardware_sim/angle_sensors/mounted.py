"""The angle sensor of an emulated rig, from its settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stimrig.hardware_sim.angle_sensors import sensor
from stimrig.hardware_sim.angle_sensors.encoder import Encoder, Mounting
from stimrig.hardware_sim.angle_sensors.sensor import AngleSensor
from stimrig.hardware_sim.load_cells.cells import with_angle
from stimrig.hardware_sim.load_cells.frames import Frame
from stimrig.hardware_sim.settings import Settings


def encoder(angle_deg: Callable[[float], float], settings: Settings) -> Encoder:
    """Reads this angle."""
    mounting = Mounting(
        settings.angle_offset_deg,
        settings.angle_direction,
        settings.angle_scale,
        settings.angle_bits,
        settings.angle_noise_deg,
    )
    return Encoder(angle_deg, mounting, settings.noise_seed)


def own_sensor(
    read: Encoder | None, send: Callable[[Frame], None], settings: Settings, epoch_us: int
) -> AngleSensor | None:
    """The sensor that sends frames of its own, or None where there is none."""
    if read is None or settings.angle != "own":
        return None
    jitter_s = settings.angle_jitter_us * 1e-6
    return AngleSensor(read, send, settings.angle_rate_hz, settings.angle_clock_ppm, jitter_s, epoch_us)


def described(settings: Settings) -> dict[str, Any]:
    """What the ready line says: how it sends, and what a calibration would find."""
    in_cell = settings.angle == "in-cell"
    return {
        "kind": "in_cell" if in_cell else "own",
        "frame_id": with_angle.CAN_ID if in_cell else sensor.CAN_ID,
        "rate_hz": settings.rate_hz if in_cell else settings.angle_rate_hz,
        "offset_deg": settings.angle_offset_deg,
        "direction": settings.angle_direction,
        "scale": settings.angle_scale,
    }
