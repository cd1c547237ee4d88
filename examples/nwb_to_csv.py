"""Turn an NWB file into a CSV file that `stimrig` reads (docs/export.md). Needs `pip install pynwb`.

    python examples/nwb_to_csv.py bench.nwb record.csv --torque Dynamometer --pulses Stim --segments epochs

TORQUE is a TimeSeries of the acquisition; `--channel` picks a column of it, and `--scale` gives the N·m of one unit:
of a force its lever arm in m, negative where the stimulated muscle's torque is negative. PULSES is a TimeSeries of the
stimulus, with the width of each pulse at its own time. SEGMENTS is a table of intervals; what is outside is left out.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from pynwb import NWBHDF5IO

MICROSECONDS = {"seconds": 1e6, "milliseconds": 1e3, "microseconds": 1.0}


def times_s(series) -> np.ndarray:
    even = series.timestamps is None
    return series.starting_time + np.arange(len(series.data)) / series.rate if even else series.timestamps[:]


def width_in_force(time_s: np.ndarray, pulse_s: np.ndarray, width_us: np.ndarray, rate_hz: float) -> np.ndarray:
    """Hold each pulse until the next one; the width is 0 where none came."""
    gap_s = np.diff(pulse_s, append=np.inf)
    until_s = pulse_s + np.where(gap_s < 1.5 / rate_hz, gap_s, 1 / rate_hz)
    last = np.searchsorted(pulse_s, time_s + 1e-6, side="right") - 1
    return np.where((last >= 0) & (time_s + 1e-6 < until_s[last]), width_us[last], 0.0)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
for name in ("nwb", "csv"):
    parser.add_argument(name)
for name in ("--torque", "--pulses", "--segments"):
    parser.add_argument(name, required=True)
parser.add_argument("--channel", type=int, default=0)
parser.add_argument("--scale", type=float, default=1.0)
parser.add_argument("--pulse-rate-hz", type=float, default=40.0)
options = parser.parse_args()

with NWBHDF5IO(options.nwb, "r") as file:
    nwb = file.read()
    torque, pulses = nwb.acquisition[options.torque], nwb.stimulus[options.pulses]
    values = np.asarray(torque.data[:], float).reshape(len(torque.data), -1)[:, options.channel]
    torque_nm = (values * torque.conversion + torque.offset) * options.scale
    time_s = times_s(torque)
    width_us = np.asarray(pulses.data[:], float) * pulses.conversion * MICROSECONDS[pulses.unit]
    held_us = width_in_force(time_s, times_s(pulses), width_us, options.pulse_rate_hz)
    spans = (nwb.epochs if options.segments == "epochs" else nwb.intervals[options.segments]).to_dataframe()
    title = next(name for name in spans.columns if name not in ("start_time", "stop_time", "tags", "timeseries"))

with Path(options.csv).open("w", newline="", encoding="utf-8") as out:
    (rows := csv.writer(out)).writerow(["time_s", "pulse_width_us", "torque_nm", "segment"])
    for start_s, stop_s, name in zip(spans["start_time"], spans["stop_time"], spans[title], strict=True):
        inside = np.flatnonzero((time_s >= start_s - 1e-9) & (time_s < stop_s - 1e-9))
        rows.writerows([repr(float(time_s[k])), held_us[k], repr(float(torque_nm[k])), name] for k in inside)
