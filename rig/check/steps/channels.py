"""Which channel is which: with one load off, that channel alone must say so."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 66, "channels", True
TRAIN_S = 0.5
FAULTS = {
    "channels_swapped": Fault(
        "pulses of a channel leave by another channel's cable: the cables, or the rig file's channels, are swapped",
        "exchange the cables, or `channel` and `connector` of the two in [[stimulator.channels]]",
    )
}


async def look(bench: Bench) -> Finding:
    names = list(bench.outputs)
    if len(names) < 2:
        raise NotDone("the rig has one channel")
    for name in names[:-1]:  # if all others are right, the last one is
        await bench.ask("unplug", name=name)
        try:
            train = await bench.play(TRAIN_S, name)
        finally:
            await bench.answer("plug", name=name)
        silent = "electrode error" in train.finished.reason
        await bench.go_on(train, provoked=silent)
        if not silent:
            bench.halted = bench.halted or "channels are swapped"
            return failed("channels_swapped", f"{name}: pulses flow with its load off", "an open electrode")
    return passed(", ".join(names), "each by its own cable")
