"""The machine that this process runs on; see `stimrig.rig.machine.Machine`."""

from __future__ import annotations

import time
import uuid
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from stimrig.rig.adapters.can_bus import CanBus
from stimrig.rig.adapters.driver import Driver, undisturbed
from stimrig.rig.adapters.files import Files
from stimrig.rig.adapters.serial_port import SerialPort
from stimrig.rig.clock import Clock
from stimrig.rig.machine import Disk

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class LocalMachine:
    """Threads, ports, adapters and files of this machine."""

    def __init__(self, clock: Clock) -> None:
        self.driver = Driver(clock)
        self.tasks, self.boot_id = self.driver.tasks, boot_id()
        self.disk: Disk = Files()

    def port(self, path: str, **arguments: Any) -> SerialPort:
        return SerialPort(path, self.tasks.clock, self.driver.post, **arguments)

    def open_bus(self, arguments: dict[str, Any], name: str) -> CanBus:
        return CanBus(arguments, name, self.tasks.clock, self.driver.post)

    def shared_bus(self, arguments: dict[str, Any], name: str) -> CanBus | None:
        return CanBus.find(arguments, name)

    def undisturbed(self) -> AbstractContextManager[None]:
        return undisturbed()

    def new_id(self) -> str:
        return uuid.uuid4().hex

    def cpu_s(self) -> float:
        return time.process_time()


def boot_id() -> str:
    """Id of this boot of the machine; empty if the system has none."""
    try:
        return BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        return ""
