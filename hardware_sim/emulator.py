"""The emulator: the devices at real ports and in real time. It carries bytes and frames, and decides nothing."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stimrig.hardware_sim import angle_sensor
from stimrig.hardware_sim.control import Control
from stimrig.hardware_sim.devices import Devices
from stimrig.hardware_sim.load_cells import TRANSPORTS
from stimrig.hardware_sim.ports import PseudoTerminal, Reactor
from stimrig.hardware_sim.timeline import WallClock

TICK_S = 0.0025
"""Period at which frames are delivered, in real time: four at a time at 1600 samples/s."""
SHORTEST_TICK_S = 0.0005


class Emulator:
    """The devices of a rig in one process and one thread.

    Time advances in `run`: each turn simulates the devices up to the present, delivers their frames, and waits for the
    host or the next tick. Before a command from the host is obeyed, time advances to its arrival.
    """

    def __init__(self, devices: Devices) -> None:
        self.devices = devices
        self._transport_class = TRANSPORTS[devices.settings.transport]
        self._reactor = Reactor()
        self._folder = Path(tempfile.mkdtemp(prefix="stimrig-emulator-"))
        self._link = self._folder / "stimulator"
        devices.unread_bytes = lambda: self.port.unread_bytes()
        devices.on_stimulator_cable = self._plug_stimulator
        devices.on_cell_cable = self._plug_cell
        self._plug_stimulator(True)
        self._plug_cell(True)
        self.clock = WallClock(devices.settings.speed)
        control = self._folder / "control"
        self._control = Control(self._reactor, control, devices, self.clock, self.catch_up, self.state)

    def ready(self) -> dict[str, Any]:
        """Return the facts that the host needs: the line printed once the devices answer."""
        settings, cell, limb = self.devices.settings, self.devices.load_cell.cell, self.devices.limb
        return {
            "stimulator": self.port.path,
            "stimulator_link": str(self._link),
            "can": self.transport.can,
            "control": str(self._control.path),
            "pid": os.getpid(),
            "stimulator_device": settings.stimulator,
            "load_cell_transport": settings.transport,
            "cell": settings.cell,
            "load_cell": cell.rig_keys,
            "samples_per_frame": cell.samples_per_frame,
            "has_counter": cell.has_counter,
            "sample_rate_hz": settings.rate_hz,
            "speed": settings.speed,
            "patient": settings.patient,
            "noise_nm": settings.noise_nm,
            "noise_seed": settings.noise_seed,
            "sync": settings.sync and cell.has_sync,
            **({"arm": limb.mode, "angle_sensor": angle_sensor.describe(settings)} if limb else {}),
        }

    def run(self, stopping: Callable[[], bool]) -> None:
        """Advance time until `stopping`."""
        tick_s = max(SHORTEST_TICK_S, TICK_S / self.devices.settings.speed)
        next_tick_s = time.monotonic()
        while not stopping():
            self.catch_up()
            self._deliver()
            self.port.flush()
            self._control.flush()
            self.port.forget_speed()
            now_s = time.monotonic()
            next_tick_s = max(next_tick_s + tick_s, now_s)
            while (left_s := next_tick_s - time.monotonic()) > 0 and not stopping():
                event_s = self.devices.next_s()  # the next tick or event, whichever comes first
                if event_s is not None:
                    left_s = min(left_s, max(self.clock.monotonic_s(event_s) - time.monotonic(), 1e-5))
                self._reactor.poll(left_s)
                self.catch_up()

    def catch_up(self) -> None:
        """Simulate everything up to the present."""
        self.devices.advance(self.clock.now_s())
        self._write()

    def close(self) -> None:
        """Unplug both devices and remove all files."""
        self._control.close()
        self._plug_stimulator(False)
        self._plug_cell(False)
        shutil.rmtree(self._folder, ignore_errors=True)

    def state(self) -> dict[str, Any]:
        """The present state, for the control line."""
        ports = {"stimulator": self.port.path if self.port.is_open else None, "can": self.transport.can}
        return {**self.devices.state(), **ports}

    def _plug_stimulator(self, plugged: bool) -> None:
        """Make a port for the stimulator and a link to it, or remove it once what was written has gone through."""
        if plugged:
            self.port = PseudoTerminal()
            self._reactor.add(self.port, self._read)
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.port.path)
        elif self.port.is_open:
            self._write()
            self._reactor.unregister(self.port)
            self.port.close()
            self._link.unlink()

    def _plug_cell(self, plugged: bool) -> None:
        """Make the cell's adapter, on a new port, or remove it once the frames sent before have gone through."""
        if plugged:
            self.transport = self._transport_class(self._reactor, self._receive_frame)
        else:
            self._deliver()
            self.transport.close()

    def _read(self) -> None:
        data = self.port.read()
        self.devices.received(self.clock.now_s(), data)
        self._write()

    def _receive_frame(self, can_id: int, data: bytes) -> None:
        self.devices.frame_received(self.clock.now_s(), can_id, data)

    def _write(self) -> None:
        for _, data in self.devices.take_bytes():
            self.port.write(data)

    def _deliver(self) -> None:
        frames = self.devices.take_frames()
        if frames:
            self.transport.send(frames)
