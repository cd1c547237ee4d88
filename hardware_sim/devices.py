"""The emulated devices of a rig: stimulator, muscle, load cell and angle sensor, on a clock that their owner advances.

There is no I/O here, no thread, no real time and no chance without a seed: the same settings and the same inputs at
the same emulated times give the same bytes, frames and pulses. The owner carries bytes and frames to a host: over real
ports (`emulator`), or within one process.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from stimrig.hardware_sim.angle_sensor import AngleSensor, Encoder
from stimrig.hardware_sim.arm.limb import Arm, Limb
from stimrig.hardware_sim.faults import Faults
from stimrig.hardware_sim.load_cells.frames import Frame
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.patients.muscle import Muscle
from stimrig.hardware_sim.sampling import take_in_order
from stimrig.hardware_sim.settings import Settings
from stimrig.hardware_sim.stimulators import STIMULATORS
from stimrig.hardware_sim.stimulators.board import Board, Electrodes, Firmware
from stimrig.hardware_sim.timeline import Timeline


class Devices:
    """All devices and their two cables; `faults` act on them.

    How often time is advanced changes nothing about what the devices do. The muscle is at rest. Without an arm the
    joint is held still and nobody measures its angle. `epoch_us` is what the sensors' clocks show at the emulated time
    0, µs. The owner may set `unread_bytes`, how many bytes that it was given the host has not read, and
    `on_stimulator_cable` and `on_cell_cable`, called after a cable is plugged (True) or unplugged (False): what was
    sent before is still to be taken.
    """

    def __init__(self, muscle: Muscle, settings: Settings, arm: Arm | None = None, epoch_us: int = 0) -> None:
        self.settings = settings
        self.random = random.Random(settings.noise_seed)
        self.timeline = Timeline()
        self.limb = Limb(muscle, arm, settings.noise_seed) if arm else None
        muscle = self.limb or muscle
        self.encoder = Encoder(self.limb.angle_deg, settings) if self.limb else None
        in_cell = self.encoder.read if self.encoder and settings.angle == "in-cell" else None
        self.load_cell = LoadCell(muscle, settings, epoch_us, in_cell)
        self.angle_sensor: AngleSensor | None = None
        if self.encoder and not in_cell:
            self.angle_sensor = AngleSensor(self.encoder, self.load_cell.add_frame, settings, epoch_us)
        self.timeline.follow = self._sample_until
        self.electrodes = Electrodes(muscle, self.load_cell.raise_sync)
        self.stimulator_plugged = True
        self.unread_bytes: Callable[[], int] = lambda: 0
        self.on_stimulator_cable: Callable[[bool], None] = lambda _plugged: None
        self.on_cell_cable: Callable[[bool], None] = lambda _plugged: None
        self._bytes: list[tuple[float, bytes]] = []
        self.board = Board(self.timeline, self.electrodes, self._write, self._count_unread_bytes)
        self.firmware: Firmware = STIMULATORS[settings.stimulator](self.board)
        self.faults = Faults(self)

    def received(self, time_s: float, data: bytes) -> None:
        """Bytes from the host on the stimulator's line at `time_s`, or now if that has passed."""
        self.advance(time_s)
        sent: bytes | None = data if self.stimulator_plugged else None
        for hook in self.board.incoming:
            sent = hook(sent) if sent else None
        if sent:
            self.firmware.received(sent)

    def frame_received(self, time_s: float, can_id: int, data: bytes) -> None:
        """A CAN frame from the host to the load cell at `time_s`, or now if that has passed."""
        self.advance(time_s)
        if self.load_cell.plugged:
            self.load_cell.cell.received(can_id, data)

    def advance(self, time_s: float) -> None:
        """Simulate up to `time_s`: all events up to it, and all samples due before it."""
        self.timeline.run_until(time_s)

    def next_s(self) -> float | None:
        """Time of the next event of the devices' own, or None; samples are none."""
        return self.timeline.next_s()

    def take_bytes(self) -> list[tuple[float, bytes]]:
        """Return the stimulator's writes since the last call, each with its emulated time."""
        data, self._bytes = self._bytes, []
        return data

    def take_frames(self) -> list[Frame]:
        """The frames of load cell and angle sensor since the last call, in the order in which they were sent."""
        return self.load_cell.take_frames()

    def plug_stimulator(self, plugged: bool = True) -> None:
        """Connect the stimulator, or pull its cable; the device itself goes on."""
        self.stimulator_plugged = plugged
        self.on_stimulator_cable(plugged)

    def plug_cell(self, plugged: bool = True) -> None:
        """Connect the adapter of load cell and angle sensor, or pull it; the sensors go on."""
        self.load_cell.plugged = plugged
        self.on_cell_cable(plugged)

    def power_cycle(self) -> None:
        """Power lost and back now, for all devices: what they have not sent is lost, and they start anew.

        The muscle, the electrodes' log, the cables and the faults that are on stay as they are.
        """
        self.firmware.reset()
        self.load_cell.restart()
        if self.angle_sensor is not None:
            self.angle_sensor.counter = 0
        self._bytes.clear()

    def state(self) -> dict[str, Any]:
        """The present state, as plain values."""
        return {
            **self.firmware.state(),
            "time_s": self.timeline.now_s,
            "pulses_received": len(self.electrodes.log),
            "unbalanced_pulses": self.electrodes.unbalanced_pulses,
            "torque_nm": self.load_cell.torque_nm,
            "samples": self.load_cell.clock.samples,
            **(self.limb.state() if self.limb else {}),
            "faults": self.faults.active(),
        }

    def _sample_until(self, time_s: float) -> None:
        if self.angle_sensor is None:
            self.load_cell.produce(time_s)
        else:
            take_in_order((self.load_cell, self.angle_sensor), time_s)

    def _write(self, frame: bytes) -> None:
        if self.stimulator_plugged:
            self._bytes.append((self.timeline.now_s, frame))

    def _count_unread_bytes(self) -> int:
        return self.unread_bytes() + sum(len(data) for _, data in self._bytes)
