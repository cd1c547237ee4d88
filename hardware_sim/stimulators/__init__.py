"""Stimulators: a board and the firmware that runs on it, with the codec of its maker."""

from __future__ import annotations

from stimrig.hardware_sim.stimulators.board import Firmware
from stimrig.hardware_sim.stimulators.p24 import P24
from stimrig.hardware_sim.stimulators.rehastim2 import RehaStim2

__all__ = ["STIMULATORS"]

STIMULATORS: dict[str, type[Firmware]] = {"p24": P24, "rehastim2": RehaStim2}
"""Firmwares by name, in alphabetical order."""
