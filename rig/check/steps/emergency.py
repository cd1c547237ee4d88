"""The stimulator's own emergency stop: it ends the train, and the rig knows."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 90, "emergency stop of the stimulator", True
TRAIN_S = 15.0
FAULTS = {
    "emergency_dead": Fault(
        "pulses go on although the emergency stop was pressed: it is not plugged in, or broken",
        "connect nobody. Plug the emergency stop in, or change it, and check again",
    )
}


async def look(bench: Bench) -> Finding:
    await bench.ask("emergency")
    flowed: list[bool] = []

    async def press() -> None:
        flowed.append(await bench.until_pulses(20))
        await bench.tell("emergency")

    train = await bench.play(TRAIN_S, during=press)
    await bench.answer("release")
    reason, bound = train.finished.reason, "ends the train"
    if train.finished.outcome == "completed":
        return failed("emergency_dead", f"all {train.sent} pulses flowed", bound)
    seen = flowed == [True] and ("electrode error" in reason or "emergency" in reason)
    await bench.go_on(train, provoked=seen)
    if not seen:
        raise NotDone(bench.halted)
    return passed(reason, bound)
