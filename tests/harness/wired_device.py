"""Both drivers against both emulated stimulators on a virtual clock, with a line of random delays."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from hardware_sim.electrodes import Electrodes, FiredPulse
from hardware_sim.stimulators import p24 as p24_device
from hardware_sim.stimulators import rehastim2 as rehastim2_device
from hardware_sim.stimulators.board import Board
from hardware_sim.timeline import Timeline
from rig.devices import p24, rehastim2
from rig.machine import Told
from tests.simulator.virtual_time import VirtualMachine

QUICK_S, STALL_S, STALLS = 0.0008, 0.3, 0.02
"""A byte's usual way, the longest stall, and how often one begins."""
PATIENCE_S = 2.5 * STALL_S
"""How long a driver waits for an answer: longer than a line that stalls both ways."""


class NoMuscle:
    """Takes pulses and gives no torque."""

    def pulse(self, time_s: float, width_us: float, current_ma: float) -> None:
        """Forget."""

    def torque_nm(self, time_s: float) -> float:
        """None."""
        return 0.0 * time_s


class WiredDevice:
    """A real driver, an emulated device, and between them a line that keeps its order and sometimes stalls.

    It is the driver's serial port (`rig.machine.Port`).
    """

    def __init__(self, name: str, machine: VirtualMachine, rng: np.random.Generator, stalls: float = STALLS) -> None:
        self._stalls, self._is_lost = stalls, False
        self._clock, self._rng = machine.clock, rng
        self._timeline, self._began_s = Timeline(), machine.clock.now_s()
        self.electrodes = Electrodes(NoMuscle())
        board = Board(self._timeline, self.electrodes, lambda frame: self._carry(1, lambda: self._answer(frame)))
        self._arrives_s = [0.0, 0.0]
        self._on_bytes: Callable[[bytes, float], None] = lambda _data, _time_s: None
        self._on_lost: Told = lambda _: None
        self._firmware = {"p24": p24_device, "rehastim2": rehastim2_device}[name].Firmware(board)
        here: Any = SimpleNamespace(tasks=machine.tasks, port=lambda _path, **_: self)
        module = {"p24": p24, "rehastim2": rehastim2}[name]
        self.driver = module.create(module.Settings(device=name, port="none", reply_timeout_s=PATIENCE_S), here)
        self._go_on()

    @property
    def felt(self) -> list[FiredPulse]:
        """What the electrodes felt, in order."""
        return self.electrodes.log

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: Told) -> None:
        self._on_bytes, self._on_lost = on_bytes, on_lost

    def write(self, data: bytes) -> int:
        if self._is_lost:
            raise OSError("unplugged")
        self._carry(0, lambda: self._receive(data))
        return len(data)

    def discard(self) -> None:
        """What was written is in the line, not in this computer."""

    def close(self) -> None:
        self._on_bytes, self._on_lost = lambda _data, _time_s: None, lambda _: None

    def lose(self) -> None:
        """Pull the plug: nothing more is written, and what the line holds does not arrive."""
        self._is_lost = True
        self._on_lost("unplugged")

    def restart(self) -> None:
        """Its power is lost and back."""
        self._timeline.run_until(self._clock.now_s() - self._began_s)
        self._firmware.reset()
        self._go_on()

    def _carry(self, way: int, arrive: Callable[[], None]) -> None:
        stalls = self._rng.random() < self._stalls
        delay_s = self._rng.uniform(0.0, STALL_S if stalls else QUICK_S)
        self._arrives_s[way] = max(self._arrives_s[way], self._clock.now_s() + delay_s)
        self._clock.call_at(self._arrives_s[way], lambda: None if self._is_lost else arrive())

    def _receive(self, data: bytes) -> None:
        self._timeline.run_until(self._clock.now_s() - self._began_s)
        self._firmware.received(data)
        self._go_on()

    def _go_on(self) -> None:
        """Let the device do what it has begun when its time comes."""
        following_s = self._timeline.next_s()
        if following_s is not None:
            self._clock.call_at(following_s + self._began_s, lambda: self._due(following_s))

    def _due(self, time_s: float) -> None:
        if self._timeline.now_s < time_s:
            self._timeline.run_until(time_s)
            self._go_on()

    def _answer(self, frame: bytes) -> None:
        self._on_bytes(frame, self._clock.now_s())
