"""Devices behind two small Protocols; a device is one file here, found by its id (the file's name).

A device module has `KIND` ("stimulator" or "load_cell"), `Settings` (a pydantic model, the device's part of the
rig file) and `create(settings, clock)`. Adding a device is adding a file.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict

from rig.errors import ConfigError
from rig.limits import Admitted, Steps
from rig.signals import Ack, TorqueBlock

Kind = Literal["stimulator", "load_cell"]


class DeviceSettings(BaseModel):
    """Base of every device's settings: unknown keys are refused, and so are NaN and infinities."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    device: str


class Stimulator(Protocol):
    """Delivers single pulses. Only `rig.gate` may hold one."""

    steps: Steps
    """What it can tell apart; the gate rounds to it."""
    silence_s: float
    """Device seconds for which it may go on pulsing by itself after the host's last word; 0: a command a pulse."""

    def open(self) -> dict[str, Any]:
        """Open the line and ask who answers; returns identity for people (device, serial number, firmware, port).

        Raises DeviceError naming the port and the mend.
        """
        ...

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        """Say where acks and the loss of the line go; both are called from the device's reader thread."""
        ...

    def arm(self) -> None:
        """Make the device ready for pulses. Raises DeviceError."""
        ...

    def send(self, pulse: Admitted, latest_s: float) -> int:
        """Hand one pulse to the line and return its number; does not wait for the ack.

        Raises LateError where the clock has passed `latest_s` right before the write, and DeviceError.
        """
        ...

    def feed(self) -> None:
        """Health has just been proven: a device with a watchdog may be kept alive, by this call alone.

        Called before each pulse and through rests while a test runs. Raises DeviceError.
        """
        ...

    def stop(self) -> None:
        """Stop stimulation; safe at any time and from any thread. What still waits in this computer to be sent is
        discarded first. Raises DeviceError.
        """
        ...

    def state(self) -> tuple[bool, str]:
        """(True if the device says that it cannot stimulate, its state in words). Raises DeviceError."""
        ...

    def close(self) -> None:
        """Give the line back; never raises."""
        ...


class LoadCell(Protocol):
    """Gives torque samples as they come."""

    sample_rate_hz: float
    counter_modulus: int
    """Where the raw counter wraps, in samples; 0: the cell has no counter."""

    def open(self) -> dict[str, Any]:
        """Open the bus and start the cell; returns identity for people. Raises DeviceError."""
        ...

    def read(self, timeout_s: float) -> TorqueBlock:
        """Samples that came within `timeout_s` real seconds, soon after the first; empty if none came.

        Raises DeviceError when the bus is gone.
        """
        ...

    def close(self) -> None:
        """Stop the cell and give the bus back; never raises."""
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
        Unknown id; the line lists those that there are.
    """
    known = library(kind)
    if not isinstance(device_id, str) or device_id not in known:
        raise ConfigError(f"{kind}.device: unknown device {device_id!r}; use one of: {', '.join(known)}")
    return known[device_id]
