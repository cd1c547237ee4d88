"""The bench of rivals: each contender at hand runs, one that is not installed and a record that is absent are told."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"SIPPY", "jax-sysid", "SysIdentPy"}


@pytest.mark.slow
def test_each_contender_predicts_a_record_or_is_told_as_not_installed(tmp_path: Path) -> None:
    only = "40 Hz,cascaded tanks,coupled drives"
    command = [sys.executable, "-m", "bench", "rivals", "--budget", "0", "--data", str(tmp_path), "--only", only]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    cells = dict(re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]+) \|$", done.stdout, re.M))
    numbers = {name: float(cell.split(",")[0]) for name, cell in cells.items() if re.match(r"[\d.]", cell)}
    told = {name: cell for name, cell in cells.items() if name not in numbers}
    assert all((name in PACKAGES and cell.startswith("not installed")) or cell == "–" for name, cell in told.items())
    assert {"ours, plain", "ours, improve", "Hammerstein-Wiener", "nlarx", "Gaussian process"} <= numbers.keys()
    assert "neural state space" in numbers
    assert numbers["ours, plain"] < 1.1
    assert re.search(r"^- cascaded tanks: absent: forgi86/sysid-neural-unc at 4652931, ", done.stdout, re.M)
    assert "- coupled drives: absent: " in done.stdout
