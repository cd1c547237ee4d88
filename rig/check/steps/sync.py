"""The stimulator's sync line at the cell: one edge for each pulse."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 60, "sync line", True
MOST_OFF = 0.05
FAULTS = {
    "sync_unwired": Fault(
        "no edge of the sync line comes with the pulses: it is not wired to the cell",
        "wire the stimulator's sync output to the cell's input, or write sync = \"\" in the rig file",
    ),
    "sync_wrong": Fault(
        "the sync line has fewer edges than there are pulses, or more",
        "look at its plug and shield, and at the signal that load_cell.sync names",
    ),
}


async def look(bench: Bench) -> Finding:
    if not bench.cell.get("sync"):
        raise NotDone("the rig file names no sync line")
    train = bench.first
    if train is None or train.finished.outcome != "completed":
        raise NotDone(bench.halted or "no whole train was played")
    edges, pulses = train.heard.edges, len(train.acknowledged)
    figure, bound = f"{edges} edges for {pulses} pulses", f"as many, within {100 * MOST_OFF:.0f} %"
    if edges == 0:
        return failed("sync_unwired", figure, bound)
    return (
        failed("sync_wrong", figure, bound) if not (abs(edges - pulses) <= MOST_OFF * pulses) else passed(figure, bound)
    )
