"""Stimulators: a board and the firmware that runs on it, with the codec of its maker. A firmware is a file here."""

from __future__ import annotations

import importlib
import pkgutil

from stimrig.hardware_sim.stimulators.board import Firmware

__all__ = ["STIMULATORS"]

for entry in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{entry.name}")
STIMULATORS = {firmware.__module__.rpartition(".")[2]: firmware for firmware in Firmware.__subclasses__()}
"""Firmwares by the name of their file, in alphabetical order."""
