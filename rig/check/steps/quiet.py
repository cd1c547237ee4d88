"""Torque at rest: a number, near zero, with little noise and no drift."""

from __future__ import annotations

import numpy as np

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 34, "torque at rest", True
MOST_OFFSET_NM, MOST_NOISE_NM, MOST_DRIFT_NM = 2.0, 0.4, 0.15
FAULTS = {
    "cell_fault": Fault(
        "the cell says that it is faulty, or gives no number",
        "read its own display or software: overload, broken bridge, wrong supply; send the cell to its maker",
    ),
    "cell_constant": Fault(
        "the cell gives exactly one value: its bridge is unplugged",
        "plug the bridge in, and pull at the lever: the value must follow",
    ),
    "noise": Fault(
        "the torque is noisy: a loose shield, mains hum, or a vibrating fixture",
        "fasten the shield at one end, keep the cell's cable off mains cables, and fix the fixture",
    ),
    "drift": Fault(
        "the torque at rest drifts: the cell warms up, is strained, or its glue lets go",
        "let it warm up for 15 min with nothing on the lever, then check again; if it still drifts, change the cell",
    ),
    "offset": Fault(
        "the torque at rest is far from zero",
        "take everything off the lever and tare the cell",
    ),
}


async def look(bench: Bench) -> Finding:
    torque_nm = bench.need_cell().samples["torque_nm"]
    finite_nm = torque_nm[np.isfinite(torque_nm)]
    share = 1 - len(finite_nm) / len(torque_nm)
    if share > 0:
        bench.halted = "the load cell gives no number"
        return failed("cell_fault", f"{100 * share:.0f} % of the samples are no number", "none")
    part = max(1, len(finite_nm) // 8)
    parts = np.array_split(finite_nm, 8)
    noise_nm = float(np.median([np.std(one) for one in parts]))
    offset_nm = bench.offset_nm = float(np.median(finite_nm))
    drift_nm = float(np.median(finite_nm[-part:]) - np.median(finite_nm[:part]))
    figure = f"{offset_nm:+.3f} N·m, noise {noise_nm:.3f} N·m, drift {drift_nm:+.3f} N·m"
    bound = f"within {MOST_OFFSET_NM} N·m, noise {MOST_NOISE_NM} N·m, drift {MOST_DRIFT_NM} N·m in 4 s"
    constant = len(np.unique(finite_nm)) == 1 and not bench.emulated
    for fault, value, most in (
        ("cell_constant", float(constant), 0.0),
        ("noise", noise_nm, MOST_NOISE_NM),
        ("drift", abs(drift_nm), MOST_DRIFT_NM),
        ("offset", abs(offset_nm), MOST_OFFSET_NM),
    ):
        if not (value <= most):
            bench.halted = f"the torque at rest is not to be relied on: {figure}"
            return failed(fault, figure, bound)
    return passed(figure, bound)
