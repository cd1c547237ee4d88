"""MATLAB: a MAT file (version 5) a record, ready for `iddata`, and `read_stimrig.m`, which makes one of it.

`y`, `u` and `Ts` are even: a lost sample is NaN. `time_s`, `torque_nm`, `pulse_width_us` and `segment` are the samples
as they were, and `stimrig` itself reads the file by them.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from scipy.io import savemat

from stimrig.api.cohort.export import NoExport, Put, Who
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward import _figures
from stimrig.api.exchange.outward.bids import grid
from stimrig.api.exchange.outward.parquet import record_row
from stimrig.identify.records.record import HELD_OUT

NAME: str = "mat"
HEADER = b"MATLAB 5.0 MAT-file, written by stimrig export"  # scipy would tell today's date
SCRIPT = """\
function data = read_stimrig(name)
% READ_STIMRIG  A file of `stimrig export --format mat` as an iddata object (System Identification Toolbox).
%
%   data = read_stimrig('sub-LABEL_ses-SESSION_KEY.mat')
%
% Output: torque (N*m). Input: pulse width in force (us). Lost samples are NaN: see misdata.
% Rows of the segment `validate` are held out: data.UserData.held_out. Without the toolbox (or in Octave) a struct
% with the same names is returned.
m = load(name);
if exist('iddata', 'file') || exist('iddata', 'class')
  data = iddata(m.y, m.u, m.Ts, 'InputName', m.InputName, 'OutputName', m.OutputName, ...
                'InputUnit', m.InputUnit, 'OutputUnit', m.OutputUnit, 'TimeUnit', m.TimeUnit, 'Tstart', m.Tstart);
  data.InterSample = m.InterSample;
  data.UserData = struct('segments', m.segments, 'held_out', logical(m.held_out), 'metadata', m.metadata);
else
  data = m;
  data.held_out = logical(m.held_out);
end
end
"""


def write(record: WholeRecord, who: Who, put: Put) -> dict[str, Any]:
    """The record's file; its row."""
    packed = io.BytesIO()
    savemat(packed, _variables(record, who), do_compression=True, long_field_names=True, oned_as="column")
    with put(f"sub-{who.label}_ses-{who.session}_{who.key}.mat") as target:
        target.write(HEADER.ljust(116) + packed.getvalue()[116:])
    return record_row(record, who)


def finish(_state: State, put: Put) -> None:
    """The script that reads a file."""
    with put("read_stimrig.m") as file:
        file.write(SCRIPT.encode())


def _variables(record: WholeRecord, who: Who) -> dict[str, Any]:
    samples, index = record.samples, record.samples["segment"].astype(int)
    names = record.about["segment_names"]
    rate_hz, start_s, at, exact = grid(record)
    if not exact:
        raise NoExport("not even", "its samples lie on no even grid within 1 µs, which iddata needs. Export Parquet.")
    inside = index >= 0  # what `stimrig` reads again
    even = {name: _even(samples[name], at) for name in ("torque_nm", "pulse_width_us")}
    held_out = np.zeros(int(at[-1]) + 1, np.uint8)
    held_out[at] = [k >= 0 and names[k] == HELD_OUT for k in index]
    segments = [{"name": name, "start_s": start_s, "end_s": end_s} for name, start_s, end_s in record.segments]
    columns = {name: samples[name][inside] for name in ("time_s", "torque_nm", "pulse_width_us")}
    for name in ("angle_rad", "velocity_rad_s", "late_s", "doubted"):
        if name in samples:
            columns[name] = samples[name][inside]
    return {
        "y": even["torque_nm"], "u": even["pulse_width_us"], "Ts": 1 / rate_hz, "Tstart": start_s,
        "OutputName": "torque", "InputName": "pulse width", "OutputUnit": "N*m", "InputUnit": "us",
        "TimeUnit": "seconds", "InterSample": "zoh", "held_out": held_out, "segments": np.array(segments, object),
        **columns, "segment": np.array([names[k] for k in index[inside]] or [""]),
        **{f"{name}_of_sensor": column for name, column in record.angle.items()},
        "pulses": dict(record.pulses) or np.zeros((0, 0)),
        "pulse_rate_hz": record.about["pulse_rate_hz"], "participant": who.participant, "session": who.session,
        "recording": who.record_id, "metadata": _figures.metadata(record),
    }  # fmt: skip


def _even(column: np.ndarray, at: np.ndarray) -> np.ndarray:
    values = np.full(int(at[-1]) + 1, np.nan)
    values[at] = column
    return values
