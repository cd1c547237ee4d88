"""A known weight on the lever: sign and calibration of the cell."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench, NotDone, mean_nm
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 40, "sign and calibration of the cell", True
MOST_PERCENT = 5.0
STILL, TURNED = 0.2, -0.5
SETTLE_S, MEAN_S = 0.5, 1.5
FAULTS = {
    "cell_upside_down": Fault(
        "the torque has the wrong sign: the cell is upside down, or the lever pulls the other way",
        "turn the cell round, or change the sign of scale_nm in the rig file; flexion is positive",
    ),
    "cell_scale": Fault(
        "the torque has the wrong size: scale_nm, the lever arm, the DBC file or the amplifier's gain is wrong",
        "compare scale_nm with full scale and lever arm (a force cell in N: the arm in m), and the DBC file's scale",
    ),
    "cell_unmoved": Fault(
        "the torque does not follow the weight: the cell is not in the path of the force, or another signal is read",
        "look at the mounting, and at load_cell.signal in the rig file",
    ),
}


async def look(bench: Bench) -> Finding:
    bench.need_cell()
    before_nm = mean_nm(await bench.listen(MEAN_S), MEAN_S, bench.sample_rate_hz)
    await bench.ask("weight_on", weight_nm=bench.weight_nm)
    try:
        loaded = await bench.listen(SETTLE_S + MEAN_S)
    finally:
        try:
            await bench.answer("weight_off")
        except NotDone:
            bench.halted = "the weight is still on the lever"
    await bench.tasks.sleep(SETTLE_S)
    found_nm = mean_nm(loaded, MEAN_S, bench.sample_rate_hz) - before_nm
    ratio = found_nm / bench.weight_nm
    figure, bound = f"{found_nm:+.3f} N·m", f"{bench.weight_nm:+.3f} N·m within {MOST_PERCENT:g} %"
    if ratio <= TURNED:
        return failed("cell_upside_down", figure, bound)
    if not (ratio >= STILL):
        return failed("cell_unmoved", figure, bound)
    return passed(figure, bound) if abs(ratio - 1) <= MOST_PERCENT / 100 else failed("cell_scale", figure, bound)
