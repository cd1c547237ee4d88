"""The stop: pulses end, and the device confirms it."""

from __future__ import annotations

from typing import Any

from stimrig.rig.acquire.evidence import NO_SIGNAL
from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed
from stimrig.rig.messages import StopEvidence

ORDER, TITLE, NEEDED = 70, "stop", True
TRAIN_S, MOST_MS = 6.0, 60.0
FAULTS = {
    "stop_unconfirmed": Fault(
        "the stimulator does not confirm the stop",
        "connect nobody. Change the stimulator's cable and check again; if it stays so, it needs its maker",
    ),
    "torque_unseen": Fault(
        "the device has stopped, but no torque came that shows it: the CAN adapter or this computer is too slow",
        "close other programs, connect the adapter without a hub, and check again",
    ),
    "stop_late": Fault(
        "pulses flow after the stop",
        "connect nobody. Close other programs and check again; if it stays so, the stimulator needs its maker",
    ),
}


async def look(bench: Bench) -> Finding:
    told = dict[str, Any]()

    async def press() -> None:
        told["playing"] = await bench.until_pulses(20)
        told["asked_s"] = bench.clock.now_s()
        told["evidence"] = await bench.rig.stop("stop of the check", bench.by)

    train = await bench.play(TRAIN_S, during=press)
    stopped = told["playing"] and train.finished.outcome == "stopped"  # else by a fault: there was nothing to stop
    evidence: StopEvidence = told["evidence"]
    last_s = max((one.written_s for one in train.pulses if one.written_s == one.written_s), default=told["asked_s"])
    after_ms = 1e3 * (last_s - told["asked_s"]) / bench.clock.speed
    extra = train.heard.edges - train.sent if bench.cell.get("sync") else 0
    figure = f"{evidence.detail}; last pulse {abs(after_ms):.0f} ms {'after' if after_ms > 0 else 'before'} the stop"
    bound = f"confirmed, no pulse later than {MOST_MS:g} ms"
    await bench.go_on(train, provoked=evidence.confirmed and stopped)
    if not evidence.confirmed:
        return failed("torque_unseen" if NO_SIGNAL in evidence.detail else "stop_unconfirmed", figure, bound)
    if not stopped:
        raise NotDone(bench.halted or "no pulses flowed that could be stopped")
    if not (after_ms <= MOST_MS and extra <= 1):
        bench.halted = "pulses flow after the stop"
        return failed("stop_late", f"{figure}, {max(0, extra)} more edges than pulses", bound)
    return passed(figure, bound)
