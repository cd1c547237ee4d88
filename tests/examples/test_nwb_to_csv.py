"""examples/nwb_to_csv.py: an NWB file of a dynamometer becomes a record."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import stimrig

pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed: pip install pynwb")

SCRIPT = Path(__file__).parents[2] / "examples" / "nwb_to_csv.py"
TIME_S = np.arange(4000) / 200.0
FORCE_N = np.round(-40 * np.sin(TIME_S), 2)
PULSES_S = np.arange(800) / 40.0
WIDTHS_US = np.where(PULSES_S % 4 < 2, 250.0, 0.0)


def dynamometer(path: Path) -> None:
    """Write force of two channels as whole numbers, pulses in seconds, epochs."""
    file = pynwb.NWBFile("a dynamometer", "x-1", datetime(2025, 3, 4, 5, 6, tzinfo=UTC))
    counts = np.column_stack([np.zeros(FORCE_N.size), np.round(FORCE_N * 100)]).astype(np.int16)
    file.add_acquisition(pynwb.TimeSeries(name="Dynamometer", data=counts, unit="newtons", conversion=0.01, rate=200.0))
    sent = WIDTHS_US > 0
    file.add_stimulus(
        pynwb.TimeSeries(name="Stim", data=WIDTHS_US[sent], unit="seconds", conversion=1e-6, timestamps=PULSES_S[sent])
    )
    file.add_epoch_column(name="label", description="what")
    for name, start_s, stop_s in (("prbs", 0.0, 10.0), ("validate", 10.0, 20.0)):
        file.add_epoch(start_s, stop_s, label=name)
    with pynwb.NWBHDF5IO(path, "w") as out:
        out.write(file)


def test_an_nwb_file_becomes_a_record(tmp_path: Path) -> None:
    dynamometer(tmp_path / "bench.nwb")
    words = "bench.nwb record.csv --torque Dynamometer --channel 1 --scale -0.25 --pulses Stim --segments epochs"
    done = subprocess.run([sys.executable, SCRIPT, *words.split()], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = stimrig.read(tmp_path / "record.csv")
    assert record.torque_nm == pytest.approx(-0.25 * FORCE_N) and record.time_s == pytest.approx(TIME_S)
    assert record.pulse_width_us == pytest.approx(np.repeat(WIDTHS_US, 5))
    assert record.segment_names == ("prbs", "validate") and record.held_out.sum() == 2000
