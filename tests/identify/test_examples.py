"""The documented example runs on data of its shape."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.harness.patients import Patient

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def test_biceps_example_on_a_simulated_muscle(tmp_path):
    """Trains of a muscle of T 0.08 s: its constants come back from pulse times and force alone."""
    rng = np.random.default_rng(0)
    with (tmp_path / "force.csv").open("w", newline="") as force, (tmp_path / "pulses.csv").open("w") as pulses:
        writer = csv.writer(force)
        writer.writerow(["train", "time_s", "force_n"])
        pulses.write("time_s\n")
        widths = np.r_[np.full(30, 300.0), np.zeros(10)]
        clean = Patient(gain=30.0, time_constant_s=0.08, damping=0.9).torque(widths, 1000, 1 / 0.032)
        for train in range(6):
            start = 5.0 + 2.1 * train
            pulses.writelines(f"{start + 0.032 * i + rng.uniform(-5e-4, 5e-4):.4f}\n" for i in range(30))
            for i, value in enumerate(clean):
                writer.writerow([train, f"{start + i / 1000:.4f}", f"{value + 0.1 * rng.standard_normal():.4f}"])
    command = [sys.executable, str(ROOT / "examples" / "biceps.py"), str(tmp_path), "--svg", str(tmp_path / "x.svg")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    constants = said.split("second order: T ")[1]
    assert float(constants.split(" s")[0]) == pytest.approx(0.08, abs=0.003)
    assert "only 2 pulse widths" in said
    assert (tmp_path / "x.svg").stat().st_size > 1000
