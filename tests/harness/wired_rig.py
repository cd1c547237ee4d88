"""A whole rig in virtual time: its gate, the real driver, a line, and the emulated stimulator's electrodes."""

from __future__ import annotations

import heapq
from types import SimpleNamespace

import numpy as np

from hardware_sim.electrodes import FiredPulse
from rig.acquire.receiver import Receiver
from rig.control.pair import Pair
from rig.control.rig import Rig
from rig.gate import Gate
from tests.harness.wired_device import WiredDevice
from tests.rig.fakes import RATE_HZ, FakeCell
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

BLOCK = 40
"""Samples that the load cell sends at once: few blocks, for speed."""
LOOK_S, LONGEST_S = 0.025, 0.24
"""How often a computer may begin to stand still, and for how long."""


class BusyClock(VirtualClock):
    """A virtual clock of a computer whose tasks stand still now and then; the devices do not."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self._rng, self.standstills = rng, 0.0
        self._look()

    def _look(self) -> None:
        if self._rng.random() < self.standstills:
            until_s = self._now_s + self._rng.uniform(0.0, LONGEST_S)
            while self._events and self._events[0][0] <= until_s:
                self._now_s = max(self._now_s, self._events[0][0])
                heapq.heappop(self._events)[2]()
            self._now_s = until_s
        self.call_at(self._now_s + LOOK_S, self._look)


class WiredPair(Pair):
    """A stimulator on an emulated line, and a load cell that measures a muscle at rest."""

    def __init__(self, name: str, machine: VirtualMachine, rng: np.random.Generator, stalls: float, rig: Rig) -> None:
        super().__init__(rig._pair._config, machine, rig._fault, rig._lost)
        self._name, self._rng, self._stalls, self._virtual = name, rng, stalls, machine
        self.devices: list[tuple[float, WiredDevice]] = []

    async def connect(self) -> None:
        """A new line to the stimulator, and a new load cell."""
        clock = self._virtual.clock
        device = WiredDevice(self._name, self._virtual, self._rng, self._stalls)
        self.devices.append((clock.now_s(), device))
        cell = FakeCell(clock, SimpleNamespace(sent=[]))  # pyright: ignore[reportArgumentType]
        cell.noise_nm = 0.01
        gate = Gate(device.driver, clock, self._on_fault, self._on_lost)
        receiver = Receiver(cell, self._tasks, self._on_lost)
        await gate.identify()
        await receiver.open()
        self.gate, self.receiver, self.steps = gate, receiver, device.driver.steps

        def beat() -> None:
            cell._block(receiver, BLOCK)
            if self.receiver is receiver:
                clock.call_at(clock.now_s() + BLOCK / RATE_HZ, beat)

        beat()
        await self._tasks.sleep(1.0)

    def felt(self) -> list[tuple[float, FiredPulse]]:
        """Every pulse that the electrodes felt, with its time on the rig's clock."""
        return [(began_s + pulse.time_s, pulse) for began_s, device in self.devices for pulse in device.felt]

    def lose(self) -> None:
        """Pull the stimulator's plug."""
        self.devices[-1][1].lose()
