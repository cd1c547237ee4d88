"""A train on each channel: every pulse is acknowledged and flows."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, Train
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 55, "pulses", True
TRAIN_S, BOUND = 2.0, "all, without an error"
FAULTS = {
    "open_electrode": Fault(
        "the stimulator says that the circuit is open: the load is not connected, or a cable is broken",
        "put the load on both cables of this output, and try another cable",
    ),
    "stop_dead": Fault(
        "the stimulator does not obey the stop: it did not confirm the end of stimulation",
        "connect nobody. Change the stimulator's cable and check again; if it stays so, it needs its maker",
    ),
    "pulse_unanswered": Fault(
        "the stimulator does not answer each pulse in time",
        "change its cable, connect it without a USB hub, and look at the latency timer of an FTDI chip",
    ),
    "torque_follows": Fault(
        "torque follows the pulses: somebody is connected instead of the dummy load, or the cell picks the pulses up",
        "take every electrode off the person, put the dummy load on, and keep the cell's cable off the electrodes'",
    ),
    "high_voltage": Fault(
        "the stimulator's source of high voltage, or its module, fails",
        "switch it off and on; if it says so again, it needs its maker",
    ),
    "computer_busy": Fault(
        "this computer stood still while pulses were due",
        "close other programs, and see `stimrig doctor` for real-time priority; then check again",
    ),
    "torque_stale": Fault(
        "the cell's samples stopped or came late while pulses flowed: a loose plug, or the adapter is too slow",
        "fasten the plugs, connect the adapter without a hub, keep its cable off the electrodes', and check again",
    ),
    "train_ended": Fault(
        "the rig ended the train for another reason",
        "the reason says what to look at",
    ),
}
REASONS = {
    "end of stimulation is not confirmed": "stop_dead",
    "electrode error": "open_electrode",
    "emergency switch": "open_electrode",
    "not acknowledged": "pulse_unanswered",
    "computer was blocked": "computer_busy",
    "torque is stale": "torque_stale",
    "no torque from the load cell": "torque_stale",
    "load cell on": "torque_stale",
    "load cell: ": "torque_stale",
    "torque ": "torque_follows",
    "high voltage": "high_voltage",
    "module error": "high_voltage",
}
"""Words of a train's end, the first that fits, and which fault they tell."""


async def look(bench: Bench) -> Finding:
    figures = []
    for name in bench.outputs:
        train = await bench.play(TRAIN_S, name)
        bench.first = bench.first or train
        found = judged(train, name)
        if found.outcome == "failed":
            await bench.go_on(train, provoked=False)
            return found
        figures.append(found.figure)
    return passed("; ".join(figures), BOUND)


def judged(train: Train, name: str) -> Finding:
    """Of one channel's train."""
    figure = (
        f"{name + ': ' if name else ''}{len(train.acknowledged)} of {train.sent} pulses that were sent acknowledged"
    )
    reason = train.finished.reason
    if train.finished.outcome != "completed":
        fault = next((fault for words, fault in REASONS.items() if words in reason), "train_ended")
        return failed(fault, f"{figure}; {reason}", BOUND)
    return failed("pulse_unanswered", figure, BOUND) if len(train.acknowledged) < train.sent else passed(figure, BOUND)
