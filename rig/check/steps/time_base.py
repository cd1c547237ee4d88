"""The cell's clock against this computer's: its rate is the rig file's."""

from __future__ import annotations

import numpy as np

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.ears import Heard
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 32, "sample rate and time base", True
CLOCK_PERCENT, RATE_PERCENT = 0.5, 3.5
WINDOWS = 24
FAULTS = {
    "sample_rate": Fault(
        "the cell samples at another rate than the rig file says",
        "set sample_rate_hz to the rate that the cell is set to, or set the cell to the rate of the rig file",
    ),
    "clock_off": Fault(
        "the cell's clock is wrong by more than a quartz ever is",
        "compare the computer's clock (`timedatectl`), then have the cell's electronics mended; or give sample_rate_hz "
        "its measured value",
    ),
}


async def look(bench: Bench) -> Finding:
    rate_hz, nominal_hz = measured_hz(bench.need_cell(), bench.modulus), bench.sample_rate_hz
    off = 100 * (rate_hz / nominal_hz - 1)
    figure, bound = f"{rate_hz:.2f} samples/s, {off:+.2f} %", f"{nominal_hz:g} samples/s within {CLOCK_PERCENT} %"
    if not (abs(off) <= RATE_PERCENT):
        bench.halted = f"load cell: {figure}"
        return failed("sample_rate", figure, bound)
    return failed("clock_off", figure, bound) if not (abs(off) <= CLOCK_PERCENT) else passed(figure, bound)


def measured_hz(heard: Heard, modulus: int) -> float:
    """Samples per second by this computer's clock: a median, so that a busy computer bends it little."""
    samples = heard.samples
    steps = heard.steps(modulus) if modulus else np.ones(len(samples) - 1)
    number = np.concatenate([[0], np.cumsum(steps)]).astype(float)
    host_s = samples["host_time_s"] - samples["host_time_s"][0]
    about_hz = number[-1] / max(float(host_s[-1]), 1e-9)
    parts = np.array_split(np.arange(len(number)), WINDOWS)
    lead_s = host_s - number / about_hz
    first = np.array([part[np.argmin(lead_s[part])] for part in parts if len(part)])
    early, late = first[: len(first) // 3], first[-(len(first) // 3) :]
    slopes = (number[late][:, None] - number[early]) / (host_s[late][:, None] - host_s[early])
    return float(np.median(slopes))
