"""Load cells: `sampler` makes samples, `cells` packs them into CAN frames, `slcan` and `socketcand` carry those."""

from __future__ import annotations

from stimrig.hardware_sim.load_cells.cells import CELLS
from stimrig.hardware_sim.load_cells.slcan import Slcan
from stimrig.hardware_sim.load_cells.socketcand import Socketcand

__all__ = ["CELLS", "TRANSPORTS"]

TRANSPORTS: dict[str, type[Slcan | Socketcand]] = {"slcan": Slcan, "socketcand": Socketcand}
"""Connections of the CAN bus to the host by name, in alphabetical order."""
