"""examples/nwb_to_csv.py and xdf_to_csv.py: a file of a dynamometer becomes a record."""

from __future__ import annotations

import struct
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stimrig

EXAMPLES = Path(__file__).parents[2] / "examples"
TIME_S = np.arange(4000) / 200.0
FORCE_N = np.round(-40 * np.sin(TIME_S), 2)
PULSES_S = np.arange(800) / 40.0
WIDTHS_US = np.where(PULSES_S % 4 < 2, 250.0, 0.0)
SENT = WIDTHS_US > 0
AHEAD_S = 100.0
"""By how much the clock of the stimulator's host is ahead."""


def converted(folder: Path, script: str, words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, EXAMPLES / script, *words.split()]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def check(folder: Path, samples: int) -> None:
    """The record is what was measured, in N·m at a lever of 0.25 m."""
    record = stimrig.read(folder / "record.csv")
    assert record.time_s == pytest.approx(TIME_S[:samples], abs=1e-6)
    assert record.torque_nm == pytest.approx(-0.25 * FORCE_N[:samples], abs=1e-6)
    assert record.pulse_width_us == pytest.approx(np.repeat(WIDTHS_US, 5)[:samples])
    assert record.segment_names == ("prbs", "validate") and record.held_out.sum() == samples - 2000


def test_an_nwb_file_becomes_a_record(tmp_path: Path) -> None:
    """Force of two channels as whole numbers, pulses in seconds, epochs."""
    pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed: pip install pynwb")
    file = pynwb.NWBFile("a dynamometer", "x-1", datetime(2025, 3, 4, 5, 6, tzinfo=UTC))
    counts = np.column_stack([np.zeros(FORCE_N.size), np.round(FORCE_N * 100)]).astype(np.int16)
    file.add_acquisition(pynwb.TimeSeries(name="Dynamometer", data=counts, unit="newtons", conversion=0.01, rate=200.0))
    file.add_stimulus(
        pynwb.TimeSeries(name="Stim", data=WIDTHS_US[SENT], unit="seconds", conversion=1e-6, timestamps=PULSES_S[SENT])
    )
    file.add_epoch_column(name="label", description="what")
    for name, start_s, stop_s in (("prbs", 0.0, 10.0), ("validate", 10.0, 20.0)):
        file.add_epoch(start_s, stop_s, label=name)
    with pynwb.NWBHDF5IO(tmp_path / "bench.nwb", "w") as out:
        out.write(file)
    words = "bench.nwb record.csv --torque Dynamometer --channel 1 --scale -0.25 --pulses Stim --segments epochs"
    done = converted(tmp_path, "nwb_to_csv.py", words)
    assert done.returncode == 0, done.stderr
    check(tmp_path, 4000)


def chunk(tag: int, body: bytes) -> bytes:
    return b"\x04" + struct.pack("<IH", len(body) + 2, tag) + body


def stream(number: int, name: str, rate_hz: float, time_s: Any, values: Any, ahead_s: float = 0.0) -> bytes:
    """Write a stream by the specification of XDF: its header, samples, clock offsets and footer."""
    texts = isinstance(values[0], str)
    width = 1 if texts else np.shape(values)[1]
    head = (
        f'<?xml version="1.0"?><info><name>{name}</name><type>x</type><channel_count>{width}</channel_count>'
        f"<nominal_srate>{rate_hz}</nominal_srate><channel_format>{'string' if texts else 'double64'}</channel_format>"
        f"<hostname>{name}</hostname></info>"
    )
    samples = b""
    for at_s, value in zip(time_s, values, strict=True):
        content = b"\x01" + bytes([len(value)]) + value.encode() if texts else struct.pack(f"<{width}d", *value)
        samples += b"\x08" + struct.pack("<d", at_s + ahead_s) + content
    which = struct.pack("<I", number)
    found = chunk(2, which + head.encode()) + chunk(3, which + b"\x04" + struct.pack("<I", len(values)) + samples)
    for at_s in range(0, 21, 5):
        found += chunk(4, which + struct.pack("<dd", at_s + ahead_s, -ahead_s))
    return found + chunk(6, which + f"<info><sample_count>{len(values)}</sample_count></info>".encode())


def test_an_xdf_file_becomes_a_record_and_a_stream_that_is_not_there_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pyxdf", reason="pyxdf is not installed: pip install pyxdf")
    (tmp_path / "lab.xdf").write_bytes(
        b"XDF:"
        + chunk(1, b'<?xml version="1.0"?><info><version>1.0</version></info>')
        + stream(1, "Biodex", 200.0, TIME_S, np.column_stack([np.zeros(FORCE_N.size), FORCE_N]))
        + stream(2, "Stim", 0.0, PULSES_S[SENT], WIDTHS_US[SENT, None], AHEAD_S)
        + stream(3, "Blocks", 0.0, [0.0, 10.0, 19.0], ["prbs", "validate", "end"], AHEAD_S)
    )
    words = "lab.xdf record.csv --torque Biodex --channel 1 --scale -0.25 --pulses {} --segments Blocks"
    done = converted(tmp_path, "xdf_to_csv.py", words.format("Stim"))
    assert done.returncode == 0, done.stderr
    check(tmp_path, 3800)
    done = converted(tmp_path, "xdf_to_csv.py", words.format("Pulses"))
    assert done.returncode == 2 and "no stream is called Pulses. It has Biodex" in done.stderr
