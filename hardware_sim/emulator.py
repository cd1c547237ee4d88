"""The emulator: stimulator, muscle, load cell and angle sensor together, and the loop that advances time."""

from __future__ import annotations

import os
import random
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hardware_sim import stimulators
from hardware_sim.angle_sensors import mounted
from hardware_sim.arm.description import Arm
from hardware_sim.arm.limb import Limb
from hardware_sim.control import Control
from hardware_sim.electrodes import Electrodes
from hardware_sim.errors import SettingsError
from hardware_sim.faults.registry import Faults
from hardware_sim.load_cells import cells, transports
from hardware_sim.load_cells.frames import CellProtocol
from hardware_sim.load_cells.sampler import LoadCell, deliver
from hardware_sim.patients.muscle import Muscle
from hardware_sim.pseudo_terminal import PseudoTerminal
from hardware_sim.reactor import Reactor
from hardware_sim.sampling import Noise, take_in_order
from hardware_sim.scan import pick
from hardware_sim.settings import Settings
from hardware_sim.stimulators.board import Board, FirmwareProtocol
from hardware_sim.timeline import Timeline, WallClock

TICK_S = 0.0025
"""How often frames are delivered, in real time: four at a time at 1600 samples/s."""
SHORTEST_TICK_S = 0.0005


class Emulator:
    """The devices of a rig in one process and one thread.

    Time advances in `run`: each turn simulates muscle, cell and firmware up to the present, delivers the frames, and
    waits for the host or the next tick. Before a command from the host is obeyed, time advances to its arrival.

    Without an arm the joint is held still and nobody measures its angle.
    """

    def __init__(self, muscle: Muscle, settings: Settings, arm: Arm | None = None) -> None:
        self.settings = settings
        self.random = random.Random(settings.noise_seed)
        self.timeline = Timeline()
        self._reactor = Reactor()
        self._folder = Path(tempfile.mkdtemp(prefix="stimrig-emulator-"))
        cell = self._cell = _cell(settings)
        epoch_us = time.time_ns() // 1000
        self.limb = Limb(muscle, arm, settings.noise_seed) if arm else None
        muscle = self.limb or muscle
        self.encoder = mounted.encoder(self.limb.angle_deg, settings) if self.limb else None
        self.load_cell = LoadCell(
            muscle,
            cell,
            Noise(settings.noise_nm, settings.noise_seed),
            settings.rate_hz,
            offset_nm=settings.torque_offset_nm,
            clock_ppm=settings.clock_ppm,
            jitter_s=settings.clock_jitter_us * 1e-6,
            has_sync=settings.sync,
            epoch_us=epoch_us,
            read_angle=self.encoder.read if self.encoder and settings.angle == "in-cell" else None,
        )
        self.angle_sensor = mounted.own_sensor(self.encoder, self.load_cell.add_frame, settings, epoch_us)
        samplers = [self.load_cell, self.angle_sensor] if self.angle_sensor else [self.load_cell]
        self.timeline.followers.append(lambda until_s: take_in_order(samplers, until_s))
        self.electrodes = Electrodes(muscle, self.load_cell.raise_sync)
        self.board = Board(self.timeline, self.electrodes, self._write, lambda: self.port.unread_bytes())
        self.firmware: FirmwareProtocol = pick(stimulators, "Firmware", settings.stimulator, "stimulator")(self.board)
        self.faults = Faults(self)
        self._received = cell.received
        self._transport_class = pick(transports, "Transport", settings.transport, "transport")
        self.plug_stimulator()
        self.plug_cell()
        self._control = Control(self._reactor, self._folder / "control", self)
        self.clock = WallClock(settings.speed)

    def ready(self) -> dict[str, Any]:
        """What the host needs to know: the line printed once the devices answer."""
        return {
            "stimulator": self.port.path,
            "stimulator_link": str(self._link),
            "can": self.transport.can,
            "control": str(self._control.path),
            "pid": os.getpid(),
            "stimulator_device": self.settings.stimulator,
            "load_cell_transport": self.settings.transport,
            "cell": self.settings.cell,
            "samples_per_frame": self._cell.samples_per_frame,
            "has_counter": self._cell.has_counter,
            "sample_rate_hz": self.settings.rate_hz,
            "speed": self.settings.speed,
            "patient": self.settings.patient,
            "noise_nm": self.settings.noise_nm,
            "noise_seed": self.settings.noise_seed,
            "sync": self.settings.sync and self._cell.has_sync,
            **({"arm": self.limb.mode, "angle_sensor": mounted.described(self.settings)} if self.limb else {}),
        }

    def run(self, stopping: Callable[[], bool]) -> None:
        """Advance time until `stopping`."""
        tick_s = max(SHORTEST_TICK_S, TICK_S / self.settings.speed)
        next_tick_s = time.monotonic()
        while not stopping():
            self.catch_up()
            deliver(self.load_cell, self.transport)
            self.port.flush()
            self.port.forget_speed()
            now_s = time.monotonic()
            next_tick_s = max(next_tick_s + tick_s, now_s)
            while (left_s := self._wait_s(next_tick_s)) > 0 and not stopping():
                self._reactor.poll(left_s)
                self.catch_up()

    def catch_up(self) -> None:
        """Simulate everything up to the present."""
        self.timeline.run_until(self.clock.now_s())

    def close(self) -> None:
        """Unplug both devices and remove all files."""
        self._control.close()
        self.unplug_stimulator()
        self.unplug_cell()
        shutil.rmtree(self._folder, ignore_errors=True)

    def plug_stimulator(self) -> None:
        """Make a port for the stimulator and a link to it."""
        self.port = PseudoTerminal()
        self._reactor.add(self.port, self._read)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(self.port.path)

    def unplug_stimulator(self) -> None:
        """Remove the stimulator's port; the device itself goes on."""
        if self.port.is_open:
            self._reactor.remove(self.port)
            self.port.close()
        self._link.unlink(missing_ok=True)

    def plug_cell(self) -> None:
        """Make the cell's adapter, on a new port."""
        self.transport = self._transport_class(self._reactor, self._received)

    def unplug_cell(self) -> None:
        """Remove the cell's adapter."""
        self.transport.close()

    def state(self) -> dict[str, Any]:
        """The present state, for the control line."""
        log = self.electrodes.log
        last_s = log[-1].time_s if log else None
        return {
            **self.firmware.state(),
            "time_s": self.timeline.now_s,
            "monotonic_s": self.clock.monotonic_s(self.timeline.now_s),
            "pulses_received": len(log),
            "pulses_delivered": self.electrodes.delivered_pulses,
            "unbalanced_pulses": self.electrodes.unbalanced_pulses,
            "last_pulse_time_s": last_s,
            "last_pulse_monotonic_s": None if last_s is None else self.clock.monotonic_s(last_s),
            "torque_nm": self.load_cell.torque_nm,
            "samples": self.load_cell.clock.samples,
            **(self.limb.state() if self.limb else {}),
            "frames_overrun": self.transport.overruns,
            "faults": self.faults.active(),
            "stimulator": self.port.path if self.port.is_open else None,
            "can": self.transport.can,
        }

    @property
    def _link(self) -> Path:
        return self._folder / "stimulator"

    def _wait_s(self, next_tick_s: float) -> float:
        """Real time until the next tick or event, whichever comes first; zero when a tick is due."""
        now_s = time.monotonic()
        left_s = next_tick_s - now_s
        event_s = self.timeline.next_s()
        if event_s is None:
            return left_s
        return min(left_s, max(self.clock.monotonic_s(event_s) - now_s, 1e-5))

    def _read(self) -> None:
        data: bytes | None = self.port.read()
        self.catch_up()
        for hook in self.board.incoming:
            data = hook(data) if data else None
        if data:
            self.firmware.received(data)

    def _write(self, frame: bytes) -> None:
        self.port.write(frame)


def _cell(settings: Settings) -> CellProtocol:
    """The cell of these settings.

    Raises
    ------
    SettingsError
        It has no frame of so many samples.
    """
    kind = pick(cells, "Cell", settings.cell, "load cell")
    if settings.samples_per_frame not in kind.layouts:
        takes = " or ".join(map(str, kind.layouts))
        raise SettingsError(
            f"--samples-per-frame must be {takes} with --cell {settings.cell}, not {settings.samples_per_frame}"
        )
    return kind(settings.samples_per_frame)
