"""The watchdog: the computer stands still in a train; no pulse flows meanwhile, and the rig ends the train itself."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 80, "watchdog", True
TRAIN_S, STILL_S, MOST_PULSES = 6.0, 1.6, 2
FAULTS = {
    "goes_on": Fault(
        "the stimulator goes on pulsing while the computer is silent: its watchdog is dead, or it is in another mode",
        "connect nobody. Give the stimulator the firmware that docs/rig-file.md names; else it needs its maker",
    ),
    "rig_went_on": Fault(
        "the rig did not end the train although the computer stood still for longer than it may",
        "this is a mistake of the software: keep the folder of the check and report it",
    ),
}


async def look(bench: Bench) -> Finding:
    async def be_silent() -> None:
        await bench.until_pulses(20)
        await bench.tell("silence")
        bench.stand_still(STILL_S)

    train = await bench.play(TRAIN_S, during=be_silent)
    ended = train.finished.outcome == "fault" and "blocked" in train.finished.reason
    await bench.go_on(train, provoked=ended)
    if train.finished.outcome != "completed" and not ended:
        raise NotDone(bench.halted)
    bound = f"at most {MOST_PULSES} pulses more than were sent, and the train ends"
    if bench.cell.get("sync"):
        extra = train.heard.edges - train.sent
        seen = f"{max(0, extra)} pulses more than were sent in {STILL_S:g} s of silence"
        dead = not (extra <= MOST_PULSES)
    else:
        dead = (await bench.answer("scope_silent")).lower().startswith("y")
        seen = f"pulses {'' if dead else 'not '}seen in {STILL_S:g} s of silence"
    figure = f"{seen}; {train.finished.reason}"
    if dead:
        bench.halted = "the stimulator goes on when the computer is silent"
        return failed("goes_on", figure, bound)
    return passed(f"{seen}; the train ended", bound) if ended else failed("rig_went_on", figure, bound)
