"""Load cells: `sampler` makes samples, `cells` packs them into CAN frames, `slcan` and `socketcand` carry those."""

from __future__ import annotations

from collections.abc import Callable

from stimrig.hardware_sim.load_cells.cells import CELLS
from stimrig.hardware_sim.load_cells.frames import FrameHandler, TransportProtocol
from stimrig.hardware_sim.load_cells.slcan import Slcan
from stimrig.hardware_sim.load_cells.socketcand import Socketcand
from stimrig.hardware_sim.ports import Reactor

__all__ = ["CELLS", "TRANSPORTS"]

TRANSPORTS: dict[str, Callable[[Reactor, FrameHandler], TransportProtocol]] = {"slcan": Slcan, "socketcand": Socketcand}
"""By name, in alphabetical order."""
