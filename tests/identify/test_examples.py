"""The documented example runs on data of its shape, and on the measured data where they are at hand."""

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
SHARED = ROOT.parent / "shared" / "data" / "biceps"


def run(folder: Path, *options: str) -> str:
    command = [sys.executable, str(ROOT / "examples" / "biceps.py"), str(folder), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    said = run(tmp_path, "--svg", str(tmp_path / "x.svg"))
    constants = said.split("second order: T ")[1]
    assert float(constants.split(" s")[0]) == pytest.approx(0.08, abs=0.003)
    assert "only 2 pulse widths" in said
    assert (tmp_path / "x.svg").stat().st_size > 1000


@pytest.mark.campaign  # the same program is run above, on what it can be judged by
@pytest.mark.skipif(not SHARED.exists(), reason="the measured data aren't beside this repository")
def test_biceps_example_on_the_measured_data():
    said = run(SHARED)
    assert "20 trains" in said
    assert float(said.split("fit ")[1].split(" %")[0]) > 65
    assert "not usable" in said
