"""The angle sensor: it gives an angle, which rises when the joint is bent."""

from __future__ import annotations

import math

from stimrig.rig.check.bench import Bench, NotDone
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 45, "angle sensor", True
LEAST_RAD = 0.2
BEND_S = 2.0
FAULTS = {
    "angle_reversed": Fault(
        "the angle falls when the joint is bent: the sensor's direction is wrong",
        "set direction = -1 in [angle_sensor] (or 1 if it is -1), or calibrate it anew with two poses",
    ),
    "angle_unmoved": Fault(
        "the angle does not follow the joint: the sensor's shaft slips, or another signal is read",
        "fasten the shaft, and look at angle_sensor.signal in the rig file",
    ),
    "angle_silent": Fault(
        "the angle sensor gives no angle",
        "check its plug, its supply and angle_sensor.bus; `candump can0` shows its frames",
    ),
}


async def look(bench: Bench) -> Finding:
    if bench.given.angle_sensor is None:
        raise NotDone("the rig file names no angle sensor")
    if bench.halted:
        raise NotDone(bench.halted)
    before = bench.rig.joint.status()
    if before.angle_rad is None or before.problem:
        return failed("angle_silent", before.problem or "no angle comes", "an angle")
    await bench.ask("bend")
    await bench.tasks.sleep(BEND_S)
    after_rad = bench.rig.joint.status().angle_rad
    moved_rad = math.nan if after_rad is None else after_rad - before.angle_rad
    figure, bound = f"{moved_rad:+.3f} rad", f"at least +{LEAST_RAD} rad"
    if moved_rad <= -LEAST_RAD:
        return failed("angle_reversed", figure, bound)
    return failed("angle_unmoved", figure, bound) if not (moved_rad >= LEAST_RAD) else passed(figure, bound)
