"""Devices behind three small Protocols; each device is one file here, found by its id (the file's name).

A device module has `KIND` ("stimulator", "load_cell" or "angle_sensor"), `Settings` (a pydantic model, the device's
part of the rig file) and `create(settings, machine)`: the device, not yet opened; it raises ConfigError where a DBC
file lacks the message or signal. To add a device, add a file.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, Literal, Protocol, Self

from pydantic import BaseModel, ConfigDict

from stimrig.rig.errors import ConfigError
from stimrig.rig.limits import Admitted, Steps
from stimrig.rig.signals import Ack, AngleScale, Block

Kind = Literal["stimulator", "load_cell", "angle_sensor"]


class DeviceSettings(BaseModel):
    """Base of every device's settings: unknown keys are refused, and so are NaN and infinities."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    device: str

    def with_cell(self, _cell: DeviceSettings) -> Self:
        """These settings, completed by those of the rig's load cell: the two may share an adapter."""
        return self


class Stimulator(Protocol):
    """Delivers single pulses. Only `stimrig.rig.gate` may hold one."""

    steps: Steps
    """Its resolution; the gate rounds to it."""

    async def open(self) -> dict[str, Any]:
        """Open the line; returns the identity to display (device, serial number, firmware, port).

        Raises DeviceError, which names the port and says how to correct it.
        """
        ...

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        """Register callbacks for acks and for the loss of the line."""
        ...

    async def arm(self) -> None:
        """Make the device ready for pulses. Raises DeviceError."""
        ...

    def send(self, pulse: Admitted, latest_s: float) -> int:
        """Write one pulse to the line and return its number; does not wait for the ack.

        Raises LateError if the clock has passed `latest_s` right before the write, and DeviceError.
        """
        ...

    def feed(self) -> None:
        """Feed the device's watchdog, if it has one. Nothing else may do so.

        Called after each health check, before each pulse and during rests. Raises DeviceError.
        """
        ...

    async def stop(self) -> None:
        """Stop stimulation; safe at any time. Raises DeviceError.

        Bytes that still wait in this computer are discarded first.
        """
        ...

    async def state(self) -> tuple[bool, str]:
        """(True if the device says that it cannot stimulate, its state in words). Raises DeviceError."""
        ...

    def close(self) -> None:
        """Close the line; never raises."""
        ...


class Sensor(Protocol):
    """Gives blocks of samples as they arrive: a load cell those of the torque."""

    sample_rate_hz: float
    counter_modulus: int
    """Value at which the raw counter wraps, in samples; 0: it has no counter."""

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        """Open the bus and start the sensor; returns the identity to display. Raises DeviceError.

        From now on each block goes to `on_block`, soon after its first sample arrived; a block may be empty. `on_lost`
        is called with the reason when the bus is gone.
        """
        ...

    async def close(self) -> None:
        """Stop the sensor and close the bus; never raises."""
        ...


class AngleSensor(Sensor, Protocol):
    """Gives the joint's angle. Opened after the load cell, closed before it."""

    scale: AngleScale
    """From its own value to the joint's angle, by the rig file. A calibration by two poses replaces it."""
    of_the_cell: bool
    """True where its samples come in the load cell's own frames, counted by the cell's counter."""
    on_the_cells_bus: bool
    """True where its frames come over the load cell's adapter: then one clock stamps both."""


@cache
def library(kind: Kind) -> dict[str, ModuleType]:
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))
    modules = {name: importlib.import_module(f"{__name__}.{name}") for name in names}
    return {name: module for name, module in modules.items() if kind == module.KIND}


def find(kind: Kind, device_id: object) -> ModuleType:
    """The module of a device. Raises ConfigError: unknown id; the message lists the known ones."""
    known = library(kind)
    if not isinstance(device_id, str) or device_id not in known:
        raise ConfigError(f"{kind}.device: unknown device {device_id!r}; use one of: {', '.join(known)}")
    return known[device_id]
