"""How soon the stimulator acknowledges a pulse, and how many are dropped."""

from __future__ import annotations

import numpy as np

from stimrig.rig.check.bench import RATE_HZ, Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed
from stimrig.rig.signals import PulseStatus

ORDER, TITLE, NEEDED = 62, "answers of the stimulator", True
MOST_MS = 10.0
MOST_SHARE = 0.1
"""Of the pulses: a busy computer drops some, more in a pause of it, and neither is the fault of a wire."""
FAULTS = {
    "answers_late": Fault(
        "answers come late by the same time: an FTDI chip keeps bytes back for 16 ms",
        "set its latency timer to 1 ms: install deploy/udev/70-stimrig.rules, plug the stimulator in again",
    ),
    "pulses_dropped": Fault(
        "many pulses were dropped: the computer is too slow or too busy",
        "close other programs, and see `stimrig doctor` for real-time priority",
    ),
}


async def look(bench: Bench) -> Finding:
    train = bench.first
    if train is None or not train.acknowledged:
        raise NotDone(bench.halted or "no pulse was acknowledged")
    late_ms = 1e3 * float(np.median([one.acknowledged_s - one.written_s for one in train.acknowledged]))
    planned = sum(one.status != PulseStatus.REST for one in train.pulses)
    paused = RATE_HZ * sum(pause["for_s"] for pause in train.finished.summary["pauses"])
    dropped = train.finished.summary["dropped_pulses"]
    figure = f"median {late_ms:.1f} ms, {dropped} of {planned} pulses dropped, {paused:.0f} of them in pauses"
    bound = f"median at most {MOST_MS:g} ms, at most {100 * MOST_SHARE:.0f} % dropped beside those"
    if not (late_ms <= MOST_MS):
        return failed("answers_late", figure, bound)
    return (
        failed("pulses_dropped", figure, bound)
        if not (dropped <= paused + MOST_SHARE * planned)
        else passed(figure, bound)
    )
