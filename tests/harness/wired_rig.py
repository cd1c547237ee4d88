"""A whole rig on a virtual clock: its gate, the real driver, a line, and the emulated stimulator's electrodes."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np

from hardware_sim.electrodes import FiredPulse
from rig.acquire.receiver import Receiver
from rig.clock import VirtualClock
from rig.control.pair import Pair
from rig.control.rig import Rig
from rig.gate import Gate
from tests.harness.wired_device import WiredDevice
from tests.rig.fakes import RATE_HZ, FakeCell

BLOCK = 40
"""Samples that the load cell sends at once: few blocks, for speed."""


class BusyClock(VirtualClock):
    """A virtual clock of a computer that stands still now and then."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self._rng, self.standstills, self._day_s = rng, 0.0, 0.0

    def wait(self, until_s: float, interrupt: threading.Event | None = None) -> bool:
        """As the base class, and sometimes longer."""
        stands = self._rng.random() < self.standstills
        return super().wait(until_s + (self._rng.uniform(0.0, 0.24) if stands else 0.0), interrupt)

    def unix_s(self) -> float:
        """Time of day, with the days that were skipped."""
        return super().unix_s() + self._day_s

    def next_day(self) -> None:
        """Skip a day of the calendar, not of the clock."""
        self._day_s += 86_400.0


class WiredPair(Pair):
    """A stimulator on an emulated line, and a load cell that measures a muscle at rest."""

    def __init__(self, name: str, clock: BusyClock, rng: np.random.Generator, stalls: float, rig: Rig) -> None:
        super().__init__(rig._pair._config, clock, rig._fault, rig._lost)
        self._name, self._rng, self._stalls, self._virtual = name, rng, stalls, clock
        self.devices: list[tuple[float, WiredDevice]] = []

    def connect(self) -> None:
        """A new line to the stimulator, and a new load cell."""
        began_s = self._virtual.now_s()
        device = WiredDevice(self._name, self._virtual, self._rng, self._stalls)
        self.devices.append((began_s, device))
        cell = FakeCell(self._virtual, SimpleNamespace(sent=[]))  # pyright: ignore[reportArgumentType]
        cell.noise_nm = 0.01
        receiver = Receiver(cell, self._virtual, self._on_lost)
        self.gate = Gate(device.driver, self._virtual, self._on_fault, self._on_lost)
        self.receiver, self.steps = receiver, device.driver.steps

        def beat() -> None:
            cell._block(receiver, BLOCK)
            if self.receiver is receiver:
                self._virtual.call_at(self._virtual.now_s() + BLOCK / RATE_HZ, beat)

        beat()
        self._virtual.wait(self._virtual.now_s() + 1.0)

    def felt(self) -> list[tuple[float, FiredPulse]]:
        """Every pulse that the electrodes felt, with its time on the rig's clock."""
        return [(began_s + pulse.time_s, pulse) for began_s, device in self.devices for pulse in device.felt]

    def lose(self) -> None:
        """Pull the stimulator's plug."""
        self.devices[-1][1].lose()
        self._on_lost("stimulator: the line is gone")
