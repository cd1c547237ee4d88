"""Turn an XDF file of LabRecorder into a CSV file that `stimrig` reads (docs/export.md). Needs `pip install pyxdf`.

    python examples/xdf_to_csv.py lab.xdf record.csv --torque Biodex --pulses Stim --segments Blocks

TORQUE is a stream of samples; `--channel` picks one of its channels, and `--scale` gives the N·m of one unit: of a
force its lever arm in m, negative where the stimulated muscle's torque is negative. PULSES is an irregular stream with
the width of each pulse, in µs. SEGMENTS is a stream of markers, each of which begins a segment; samples before the
first, and from a marker `end` on, are left out. pyxdf brings the streams to one clock; lost samples
stay gaps, and `stimrig` takes the jitter off.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import pyxdf


def width_in_force(time_s: np.ndarray, pulse_s: np.ndarray, width_us: np.ndarray, rate_hz: float) -> np.ndarray:
    """Hold each pulse until the next one; the width is 0 where none came."""
    gap_s = np.diff(pulse_s, append=np.inf)
    until_s = pulse_s + np.where(gap_s < 1.5 / rate_hz, gap_s, 1 / rate_hz)
    last = np.searchsorted(pulse_s, time_s + 1e-6, side="right") - 1
    return np.where((last >= 0) & (time_s + 1e-6 < until_s[last]), width_us[last], 0.0)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("xdf")
parser.add_argument("csv")
parser.add_argument("--torque", required=True)
parser.add_argument("--channel", type=int, default=0)
parser.add_argument("--scale", type=float, default=1.0)
parser.add_argument("--pulses", required=True)
parser.add_argument("--pulse-rate-hz", type=float, default=40.0)
parser.add_argument("--segments", required=True)
options = parser.parse_args()

streams = {stream["info"]["name"][0]: stream for stream in pyxdf.load_xdf(options.xdf, dejitter_timestamps=False)[0]}
for name in (options.torque, options.pulses, options.segments):
    if name not in streams:
        parser.error(f"{options.xdf}: no stream is called {name}. It has {', '.join(streams)}.")
torque, pulses, marks = (streams[name] for name in (options.torque, options.pulses, options.segments))
time_s = torque["time_stamps"]
torque_nm = torque["time_series"][:, options.channel] * options.scale
held_us = width_in_force(time_s, pulses["time_stamps"], pulses["time_series"][:, 0], options.pulse_rate_hz)
index = np.searchsorted(marks["time_stamps"], time_s + 1e-9, side="right") - 1

with Path(options.csv).open("w", newline="", encoding="utf-8") as out:
    rows = csv.writer(out)
    rows.writerow(["time_s", "pulse_width_us", "torque_nm", "segment"])
    for k in np.flatnonzero(index >= 0):
        name = marks["time_series"][index[k]][0]
        if name != "end":
            rows.writerow([repr(float(time_s[k] - time_s[0])), held_us[k], repr(float(torque_nm[k])), name])
