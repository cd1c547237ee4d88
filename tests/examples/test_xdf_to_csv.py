"""examples/xdf_to_csv.py: an XDF file of LabRecorder becomes a record."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stimrig

pytest.importorskip("pyxdf", reason="pyxdf is not installed: pip install pyxdf")

SCRIPT = Path(__file__).parents[2] / "examples" / "xdf_to_csv.py"
TIME_S = np.arange(4000) / 200.0
FORCE_N = np.round(-40 * np.sin(TIME_S), 2)
PULSES_S = np.arange(800) / 40.0
WIDTHS_US = np.where(PULSES_S % 4 < 2, 250.0, 0.0)
AHEAD_S = 100.0
"""By how much the clock of the stimulator's host is ahead."""


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


def test_an_xdf_file_becomes_a_record(tmp_path: Path) -> None:
    sent = WIDTHS_US > 0
    force = np.column_stack([np.zeros(FORCE_N.size), FORCE_N])
    (tmp_path / "lab.xdf").write_bytes(
        b"XDF:"
        + chunk(1, b'<?xml version="1.0"?><info><version>1.0</version></info>')
        + stream(1, "Biodex", 200.0, TIME_S, force)
        + stream(2, "Stim", 0.0, PULSES_S[sent], WIDTHS_US[sent, None], AHEAD_S)
        + stream(3, "Blocks", 0.0, [0.0, 10.0, 19.0], ["prbs", "validate", "end"], AHEAD_S)
    )
    words = "lab.xdf record.csv --torque Biodex --channel 1 --scale -0.25 --pulses Stim --segments Blocks"
    done = subprocess.run([sys.executable, SCRIPT, *words.split()], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = stimrig.read(tmp_path / "record.csv")
    assert record.time_s == pytest.approx(TIME_S[:3800], abs=1e-6)
    assert record.torque_nm == pytest.approx(-0.25 * FORCE_N[:3800], abs=1e-6)
    assert record.pulse_width_us == pytest.approx(np.repeat(WIDTHS_US, 5)[:3800])
    assert record.segment_names == ("prbs", "validate") and record.held_out.sum() == 1800


def test_a_stream_that_is_not_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "lab.xdf").write_bytes(b"XDF:" + stream(1, "Biodex", 200.0, TIME_S, FORCE_N[:, None]))
    words = "lab.xdf record.csv --torque Biodex --pulses Stim --segments Blocks"
    done = subprocess.run([sys.executable, SCRIPT, *words.split()], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "no stream is called Stim. It has Biodex" in done.stderr
