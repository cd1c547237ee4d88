"""How soon the stimulator acknowledges a pulse."""

from __future__ import annotations

import numpy as np

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, within

ORDER, TITLE, NEEDED = 62, "answers of the stimulator", True
MOST_MS = 10.0
FAULTS = {
    "answers_late": Fault(
        "answers come late by the same time: an FTDI chip keeps bytes back for 16 ms",
        "set its latency timer to 1 ms: install deploy/udev/70-stimrig.rules, plug the stimulator in again",
    )
}


async def look(bench: Bench) -> Finding:
    train = bench.first
    if train is None or not train.acknowledged:
        raise NotDone(bench.halted or "no pulse was acknowledged")
    late_ms = 1e3 * float(np.median([one.acknowledged_s - one.written_s for one in train.acknowledged]))
    bound = f"median at most {MOST_MS:g} ms"
    return within(late_ms, 0.0, MOST_MS, "answers_late", f"median {late_ms:.1f} ms", bound)
