"""Width and current of a pulse, as an oscilloscope over the dummy load shows them."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 64, "width and current at the load", False
WIDTH_PERCENT, CURRENT_PERCENT = 10.0, 15.0
TRAIN_S = 2.0
FAULTS = {
    "width_wrong": Fault(
        "the pulse at the load is wider or narrower than the device was told",
        "connect nobody. Check the time base of the oscilloscope; then the stimulator needs its maker",
    ),
    "current_wrong": Fault(
        "the current through the load is another one than the device was told",
        "measure the resistor, and give its value with --dummy-load-ohm; else the stimulator needs its maker",
    ),
}


async def look(bench: Bench) -> Finding:
    await bench.ask("scope")
    train = await bench.play(TRAIN_S)
    await bench.go_on(train, provoked=False)
    if bench.halted:
        raise NotDone(bench.halted)
    width_us = await bench.number("scope_width_us")
    current_ma = 1000 * await bench.number("scope_voltage_v", ohm=bench.ohm) / bench.ohm
    asked_us, asked_ma = bench.width_us, bench.rig.pair.steps.current(bench.current_ma)
    figure = f"{width_us:g} µs, {current_ma:.1f} mA"
    bound = f"{asked_us:g} µs within {WIDTH_PERCENT:g} %, {asked_ma:g} mA within {CURRENT_PERCENT:g} %"
    if not (abs(width_us / asked_us - 1) <= WIDTH_PERCENT / 100):
        bench.halted = "the width of pulses at the load is wrong"
        return failed("width_wrong", figure, bound)
    if not (abs(current_ma / asked_ma - 1) <= CURRENT_PERCENT / 100):
        bench.halted = "the current through the load is wrong"
        return failed("current_wrong", figure, bound)
    return passed(figure, bound)
