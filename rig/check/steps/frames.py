"""The load cell's frames: they come whole, none is lost, and the counter counts."""

from __future__ import annotations

import numpy as np

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.ears import Heard
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 30, "load cell's frames", True
LISTEN_S = 4.0
MOST_LOST = 0.002
"""As a share: a busy computer may miss a frame or two in seconds."""
GAP = 1.5
FAULTS = {
    "bit_rate": Fault(
        "errors of the bus and no frame: the bit rate is wrong",
        "set the cell's bit rate (BITRATE= in /etc/stimrig/can.env, or bitrate in load_cell.bus), and restart the link",
    ),
    "termination": Fault(
        "errors of the bus between the frames: a terminating resistor is missing, or the cable is damaged",
        "put 120 Ω at both ends of the bus (60 Ω between CAN_H and CAN_L with the power off), and look at the plugs",
    ),
    "cell_silent": Fault(
        "no frame of the cell comes: no supply, not started, or another identifier",
        "check its supply, start_frames and the message of the DBC file; `candump can0` shows what comes",
    ),
    "wrong_dbc": Fault(
        "frames come that do not fit the description",
        "give the DBC file of this cell (load_cell.dbc, message and signal)",
    ),
    "counter_stuck": Fault(
        "readings come, but their counter stands still",
        'name the right signal in load_cell.counter, or "" if the cell counts nothing; else the cell needs its maker',
    ),
    "frames_dropped": Fault(
        "frames are lost although the bus reports no error: the adapter or its USB hub is too slow",
        "connect the adapter without a hub, lower the bus load, and take other programs from this computer",
    ),
}


async def look(bench: Bench) -> Finding:
    if bench.halted:
        raise NotDone(bench.halted)
    heard = await bench.listen(LISTEN_S)
    found = _judged(heard, bench)
    if found.outcome == "failed":
        bench.halted = f"load cell: {FAULTS[found.fault].cause}"
    bench.quiet = heard
    return found


def _judged(heard: Heard, bench: Bench) -> Finding:
    count, bound = len(heard.samples), f"at most {100 * MOST_LOST:g} % lost, no error of the bus"
    if count < 10:
        fault = "bit_rate" if heard.errors else "wrong_dbc" if heard.malformed else "cell_silent"
        return failed(fault, f"{count} samples, {heard.errors} errors of the bus, {heard.malformed} misfits", bound)
    if bench.modulus and not heard.steps(bench.modulus).any():
        return failed("counter_stuck", f"{count} samples, all with number {heard.samples['counter'][0]}", bound)
    lost = lost_share(heard, bench.modulus)
    figure = f"{count} samples, {100 * lost:.2f} % lost, {heard.errors} errors of the bus"
    if heard.errors > max(1.0, MOST_LOST * count):
        return failed("termination", figure, bound)
    if heard.malformed > MOST_LOST * count:
        return failed("wrong_dbc", f"{figure}, {heard.malformed} misfits", bound)
    return failed("frames_dropped", figure, bound) if not (lost <= MOST_LOST) else passed(figure, bound)


def lost_share(heard: Heard, modulus: int) -> float:
    """Samples that are missing, as a share of all: by the counter, else by the adapter's stamps; 0 without either."""
    count = len(heard.samples)
    if modulus:
        steps = heard.steps(modulus)
        return float(np.sum(steps[steps > 1] - 1) / count)
    apart_s = np.diff(heard.samples["stamp_s"])
    if not np.isfinite(apart_s).all() or not len(apart_s):
        return 0.0
    usual_s = float(np.median(apart_s[apart_s > 0]))
    return float(np.sum(np.round(apart_s[apart_s > GAP * usual_s] / usual_s) - 1) / count)
