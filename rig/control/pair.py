"""The devices of a rig, which are connected, checked and disconnected together."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from stimrig.rig import devices, limits
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.receiver import FRESH_S, Receiver
from stimrig.rig.acquire.stream import SETTLE_S
from stimrig.rig.config import RigConfig
from stimrig.rig.errors import DeviceError
from stimrig.rig.gate import Gate
from stimrig.rig.machine import Machine
from stimrig.rig.signals import AngleScale

log = logging.getLogger("rig.pair")


class Pair:
    """A stimulator behind its gate and a load cell behind its receiver, both None while not connected, and the angle
    sensor of a rig that has one.

    The angle sensor may be missing: it opens itself, and a test that needs it finds out.
    """

    def __init__(
        self, config: RigConfig, machine: Machine, on_fault: Callable[[str], None], on_lost: Callable[[str], None]
    ) -> None:
        self._config, self._machine = config, machine
        self._tasks, self._clock = machine.tasks, machine.tasks.clock
        self._on_fault, self._on_lost = on_fault, on_lost
        self.gate: Gate | None = None
        self.receiver: Receiver | None = None
        self.angle: AngleReceiver | None = None
        self.found_state = ""
        """State that the stimulator reported when it was connected."""
        self.steps = limits.FINEST
        """The stimulator's resolution."""
        self._identity: dict[str, dict[str, Any]] = {"stimulator": {}, "load_cell": {}}
        self._scale: AngleScale | None = None

    @property
    def identity(self) -> dict[str, dict[str, Any]]:
        return self._identity if self.angle is None else {**self._identity, "angle_sensor": self.angle.identity}

    async def connect(self) -> None:
        """Open both. A stimulator that is found able to stimulate is stopped at once, since no test runs.

        Raises DeviceError (both are then closed) and ConfigError (the DBC lacks the signal).
        """
        settings = self._config.stimulator, self._config.load_cell
        stimulator = devices.find("stimulator", settings[0].device).create(settings[0], self._machine)
        cell = devices.find("load_cell", settings[1].device).create(settings[1], self._machine)
        gate = Gate(stimulator, self._clock, self._on_fault, self._on_lost)
        receiver = Receiver(cell, self._tasks, self._on_lost)
        self._identity["stimulator"] = await gate.identify()
        try:
            await self._stop_what_was_left(gate)
            self._identity["load_cell"] = await receiver.open()
        except DeviceError:
            await gate.disconnect()
            raise
        self.gate, self.receiver, self.steps = gate, receiver, stimulator.steps
        self._watch_angle()

    def _watch_angle(self) -> None:
        """After the load cell: the angle sensor may share its bus."""
        settings = self._config.angle_sensor
        if settings is None:
            return
        sensor = devices.find("angle_sensor", settings.device).create(settings, self._machine)
        self.angle = AngleReceiver(sensor, self._tasks)
        self.rescale(self._scale)
        self.angle.start()

    def rescale(self, scale: AngleScale | None) -> None:
        """The angle by this calibration from now on; None: as the rig file says."""
        self._scale = scale
        if self.angle is not None:
            self.angle.rescale(scale or self.angle.sensor.scale)

    async def _stop_what_was_left(self, gate: Gate) -> None:
        safe, state = await gate.state()
        self.found_state = state
        if not safe:
            log.warning("the stimulator was found %s; stopped", state)
            await gate.stop()
            safe, state = await gate.state()
            if not safe:
                raise DeviceError(f"stimulator: it was stopped, and still says {state}; switch it off and on")

    async def disconnect(self) -> None:
        """Stop stimulation and close all; never raises."""
        gate, angle, receiver = self.gate, self.angle, self.receiver
        self.gate = self.receiver = self.angle = None
        if gate is not None:
            await gate.disconnect()
        if angle is not None:
            await angle.close()
        if receiver is not None:
            await receiver.close()

    async def reconnect(self) -> None:
        """Close both, open them again and check that torque arrives. Raises DeviceError."""
        await self.disconnect()
        await self.connect()
        if not await self.torque_comes():
            raise DeviceError("load cell: connected, but no torque arrives; check its cable and start frames")

    async def both_answer(self) -> bool:
        """Stop the stimulator, ask its state, and check that torque arrives; False if one of them fails."""
        gate = self.gate
        if gate is None or self.receiver is None:
            return False
        try:
            await gate.stop()
            safe, _ = await gate.state()  # of the same one: the rig may be shutting down meanwhile
        except DeviceError:
            return False
        return safe and await self.torque_comes()

    async def torque_comes(self) -> bool:
        """Wait a short time for a new sample; return whether one came."""
        receiver = self.receiver
        if receiver is None:
            return False
        asked_s, waited_s = self._clock.now_s(), 0.0
        while receiver.age_s(asked_s) >= 0 or not receiver.settled():
            if waited_s > (FRESH_S + SETTLE_S if receiver.age_s(asked_s) < 0 else FRESH_S):
                return False
            waited_s += await self._tasks.look_again()
        return True
