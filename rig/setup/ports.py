"""Ports and CAN interfaces of this machine, and which device each may be. No port is opened."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from serial.tools import list_ports

from stimrig.rig.check.surroundings import Surroundings

KINDS = {
    "0483:5740": ("p24", "Hasomed RehaMove P24 (or another device with ST's number)"),
    "0403:6001": ("rehastim2", "FTDI adapter: Hasomed RehaStim 2, or an slcan adapter"),
    "0403:6014": ("rehastim2", "FTDI adapter: Hasomed RehaStim 2, or an slcan adapter"),
    "0403:6015": ("slcan", "FTDI adapter: an slcan adapter, or a Hasomed RehaStim 2"),
    "16d0:117e": ("slcan", "CANable with slcan firmware"),
    "ad50:60c4": ("slcan", "CANable or another adapter with slcan firmware"),
}
"""USB vendor and product, as in `deploy/udev/70-stimrig.rules` -> what the device is most likely, and in words."""
NAMES = Path("/dev/stimrig")


class Found(NamedTuple):
    """A serial port: its most stable name, its likely kind (empty: unknown), and what it is in words."""

    name: str
    kind: str
    words: str


def serial_ports() -> list[Found]:
    """Those that the system lists, under the name by udev where there is one."""
    names = {os.path.realpath(place): str(place) for place in sorted(_names())}
    found = []
    for port in sorted(list_ports.comports(), key=lambda port: port.device):
        number = "" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}"
        kind, words = KINDS.get(number, ("", port.description or "unknown"))
        serial = f", serial number {port.serial_number}" if port.serial_number else ""
        name = names.get(os.path.realpath(port.device), port.device)
        found.append(Found(name, kind, f"{words}{f' [{number}]' if number else ''}{serial}"))
    return found


def can_interfaces() -> list[str]:
    """Names of those that the kernel has."""
    return Surroundings().can_links()


def _names() -> list[Path]:
    return list(NAMES.iterdir()) if NAMES.is_dir() else []


def proposed(ports: list[Found], kind: str) -> str:
    """The port of that kind, where there is exactly one; else empty."""
    likely = [port.name for port in ports if port.kind == kind]
    return likely[0] if len(likely) == 1 else ""
