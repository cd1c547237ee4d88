"""An angle sensor that lives on a virtual clock, in one thread: for tests of receiver, run and recording."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.errors import DeviceError
from stimrig.rig.signals import ANGLE_SAMPLE, AngleScale, Block
from tests.simulator.virtual_time import VirtualClock, VirtualMachine

RATE_HZ = 200.0
PER_BLOCK = 2


def still(_: float) -> float:
    """A joint that is held at 60 degrees."""
    return math.radians(60)


class FakeSensor:
    """Blocks of two samples with a 16-bit counter, degrees with an offset and reversed; faults are attributes."""

    sample_rate_hz = RATE_HZ
    counter_modulus = 65536
    scale = AngleScale(offset=30.0, direction=-1, radians_per_unit=math.pi / 180)
    of_the_cell = False
    on_the_cells_bus = True

    def __init__(self, clock: VirtualClock, angle_rad: Callable[[float], float] = still) -> None:
        self.clock, self.angle_rad = clock, angle_rad
        self.silent = self.nan = self.repeating = False
        self.fault: int = 0
        self.add_deg = 0.0
        self.rate = 1.0
        self.skip = 0
        self.late_s = 0.0
        self.noise_deg = 0.02
        self.counter = 65400
        self._rng = np.random.default_rng(3)

    async def open(self, *_: Callable[..., None]) -> dict[str, Any]:
        if self.silent:
            raise DeviceError("angle_sensor.bus: it is not there")
        return {"device": "fake"}

    async def close(self) -> None: ...

    def block(self, n: int = PER_BLOCK, at_s: float | None = None) -> Block:
        """The next samples; the last one is taken now."""
        now_s = self.clock.now_s() if at_s is None else at_s
        if not self.repeating:
            self.counter += n + self.skip
        self.skip = 0
        times_s = now_s - np.arange(n)[::-1] / RATE_HZ
        samples = np.zeros(n, ANGLE_SAMPLE)
        samples["host_time_s"], samples["stamp_s"] = now_s, np.nan
        degrees = np.degrees([self.angle_rad(t) for t in times_s]) + self.noise_deg * self._rng.standard_normal(n)
        samples["raw"] = np.nan if self.nan else 30.0 - degrees + self.add_deg
        samples["angle_rad"] = self.scale.angle_rad(samples["raw"])
        samples["counter"] = (self.counter - np.arange(n)[::-1]) % 65536
        samples["fault"] = self.fault
        return Block(samples)

    def feed(self, receiver: AngleReceiver, until_s: float) -> None:
        """Schedule blocks for the receiver until a time."""
        period_s = PER_BLOCK / RATE_HZ / self.rate
        first_s = self.clock.now_s() + 0.0003  # between two blocks of the cell
        for i in range(1, math.ceil((until_s - first_s) / period_s)):
            self.clock.call_at(first_s + i * period_s, lambda: self._send(receiver))

    def _send(self, receiver: AngleReceiver) -> None:
        if self.silent:
            self.counter += PER_BLOCK
            return
        block = self.block()
        if self.late_s:
            self.clock.call_at(self.clock.now_s() + self.late_s, lambda: self._arrive(receiver, block))
        else:
            receiver.take(block)

    def _arrive(self, receiver: AngleReceiver, block: Block) -> None:
        block.samples["host_time_s"] = self.clock.now_s()
        receiver.take(block)


class OpenedSensor(FakeSensor):
    """Its samples come while it is open; its adapter may be missing or slow."""

    def __init__(self, machine: VirtualMachine, angle_rad: Callable[[float], float] = still) -> None:
        super().__init__(machine.clock, angle_rad)
        self.tasks = machine.tasks
        self.gone, self.opens_s, self.closes_s, self.per_block = False, 0.0, 0.0, PER_BLOCK
        self.done: list[str] = []
        self._opened = 0

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        await self.tasks.sleep(self.opens_s)
        if self.gone:
            raise DeviceError("angle sensor: no adapter")
        self.done.append("opened")
        self.on_lost, self._opened = on_lost, len(self.done)
        self._beat(on_block, self._opened)
        return {"device": "here"}

    async def close(self) -> None:
        self._opened = 0
        await self.tasks.sleep(self.closes_s)
        self.done.append("closed")

    def _beat(self, on_block: Callable[[Block], None], opened: int) -> None:
        if self._opened != opened:
            return
        if self.gone:
            self.on_lost("angle sensor on x: the bus was lost: gone")
            return
        if not self.silent:
            on_block(self.block(self.per_block))
        self.clock.call_at(self.clock.now_s() + self.per_block / RATE_HZ, lambda: self._beat(on_block, opened))
