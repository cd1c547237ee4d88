"""What a fault can act on, so that faults do not need to know the emulator."""

from __future__ import annotations

import random
from typing import Protocol

from stimrig.hardware_sim.angle_sensors.encoder import Encoder
from stimrig.hardware_sim.angle_sensors.sensor import AngleSensor
from stimrig.hardware_sim.load_cells.sampler import LoadCell
from stimrig.hardware_sim.stimulators.board import Board, FirmwareProtocol
from stimrig.hardware_sim.timeline import Timeline


class Target(Protocol):
    """The emulated devices and their cables; `random` gives every random number that a fault needs.

    The encoder is there where the rig has an arm, the angle sensor where the angle comes in frames of its own.
    """

    random: random.Random
    timeline: Timeline
    board: Board
    firmware: FirmwareProtocol
    load_cell: LoadCell
    encoder: Encoder | None
    angle_sensor: AngleSensor | None

    def plug_stimulator(self) -> None:
        """Connect the stimulator."""
        ...

    def unplug_stimulator(self) -> None:
        """Pull the stimulator's cable."""
        ...

    def plug_cell(self) -> None:
        """Connect the load cell's adapter."""
        ...

    def unplug_cell(self) -> None:
        """Pull the load cell's adapter."""
        ...
