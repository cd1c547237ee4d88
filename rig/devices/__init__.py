"""Devices behind three small Protocols; each device is one file here, found by its id (the file's name).

A device module has `KIND` ("stimulator", "load_cell" or "angle_sensor"), `Settings` (a pydantic model, the device's
part of the rig file) and `create(settings, clock)`. To add a device, add a file.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, Literal, Protocol, Self

from pydantic import BaseModel, ConfigDict

from rig.errors import ConfigError
from rig.limits import Admitted, Steps
from rig.signals import Ack, AngleBlock, AngleScale, TorqueBlock

Kind = Literal["stimulator", "load_cell", "angle_sensor"]


class DeviceSettings(BaseModel):
    """Base of every device's settings: unknown keys are refused, and so are NaN and infinities."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    device: str

    def beside(self, _cell: DeviceSettings) -> Self:
        """These settings, completed by those of the rig's load cell: the two may share an adapter."""
        return self


class Stimulator(Protocol):
    """Delivers single pulses. Only `rig.gate` may hold one."""

    steps: Steps
    """Its resolution; the gate rounds to it."""
    silence_s: float
    """Device seconds for which it may continue to pulse after the host's last command; 0: one command per pulse."""

    def open(self) -> dict[str, Any]:
        """Open the line; returns the identity to display (device, serial number, firmware, port).

        Raises DeviceError, which names the port and says how to correct it.
        """
        ...

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        """Register callbacks for acks and for the loss of the line; called from the device's reader thread."""
        ...

    def arm(self) -> None:
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

    def stop(self) -> None:
        """Stop stimulation; safe at any time and from any thread. Raises DeviceError.

        Bytes that still wait in this computer are discarded first.
        """
        ...

    def state(self) -> tuple[bool, str]:
        """(True if the device says that it cannot stimulate, its state in words). Raises DeviceError."""
        ...

    def close(self) -> None:
        """Close the line; never raises."""
        ...


class LoadCell(Protocol):
    """Gives torque samples as they arrive."""

    sample_rate_hz: float
    counter_modulus: int
    """Value at which the raw counter wraps, in samples; 0: the cell has no counter."""

    def open(self) -> dict[str, Any]:
        """Open the bus and start the cell; returns the identity to display. Raises DeviceError."""
        ...

    def read(self, timeout_s: float) -> TorqueBlock:
        """Samples that arrive within `timeout_s` real seconds; returns soon after the first one; may be empty.

        Raises DeviceError when the bus is gone.
        """
        ...

    def close(self) -> None:
        """Stop the cell and close the bus; never raises."""
        ...


class AngleSensor(Protocol):
    """Gives the joint's angle as it arrives. Opened after the load cell, closed before it."""

    sample_rate_hz: float
    counter_modulus: int
    """As of a load cell."""
    scale: AngleScale
    """From its own value to the joint's angle, by the rig file. A calibration by two poses replaces it."""
    of_the_cell: bool
    """Whether its samples come in the load cell's own frames, counted by the cell's counter."""
    on_the_cells_bus: bool
    """Whether its frames come over the load cell's adapter: then one clock stamps both."""

    def open(self) -> dict[str, Any]:
        """Open the bus, or share the load cell's; returns the identity to display. Raises DeviceError."""
        ...

    def read(self, timeout_s: float) -> AngleBlock:
        """As `LoadCell.read`."""
        ...

    def close(self) -> None:
        """Close the bus, or leave it to the load cell; never raises."""
        ...


@cache
def library(kind: Kind) -> dict[str, ModuleType]:
    """Device modules of a kind, by id."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))
    modules = {name: importlib.import_module(f"{__name__}.{name}") for name in names}
    return {name: module for name, module in modules.items() if kind == module.KIND}


def find(kind: Kind, device_id: object) -> ModuleType:
    """The module of a device.

    Raises
    ------
    ConfigError
        Unknown id; the message lists the known ones.
    """
    known = library(kind)
    if not isinstance(device_id, str) or device_id not in known:
        raise ConfigError(f"{kind}.device: unknown device {device_id!r}; use one of: {', '.join(known)}")
    return known[device_id]
