"""What a fault can act on, so that faults do not need to know the emulator."""

from __future__ import annotations

import random
from typing import Protocol

from hardware_sim.load_cells.sampler import LoadCell
from hardware_sim.stimulators.board import Board, FirmwareProtocol
from hardware_sim.timeline import Timeline


class Target(Protocol):
    """The emulated devices and their cables; `random` gives every random number that a fault needs."""

    random: random.Random
    timeline: Timeline
    board: Board
    firmware: FirmwareProtocol
    load_cell: LoadCell

    def plug_stimulator(self) -> None:
        """Connect the stimulator, on a new port."""
        ...

    def unplug_stimulator(self) -> None:
        """Remove the stimulator's port."""
        ...

    def plug_cell(self) -> None:
        """Connect the load cell's adapter, on a new port."""
        ...

    def unplug_cell(self) -> None:
        """Remove the load cell's adapter."""
        ...
