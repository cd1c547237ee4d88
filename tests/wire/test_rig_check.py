"""The check on the wire, as `stimrig rig check` starts it: real ports, the emulator's hands, the report on disk."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from tests.harness.processes import ROOT, Bench

pytestmark = pytest.mark.wire
TIMES = {"ack_delay", "stop", "silence", "time_base", "frames"}
"""Steps that a busy machine may fail by itself, and what is not done after them."""


def checked(bench: Bench) -> tuple[int, dict[str, Any]]:
    words = ["--emulator-json", json.dumps(bench.emulator.ready), "--data", str(bench.data)]
    command = [sys.executable, "-m", "stimrig.rig.check", *words]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert ended.stdout, ended.stderr
    return ended.returncode, json.loads(ended.stdout)


def test_a_sound_rig(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench("--noise-seed", "7", "--stimulator", "rehastim2")
    code, report = checked(bench)
    assert json.loads((bench.data / "check.json").read_text()) == report
    assert (code == 0) == (report["verdict"] == "sound")
    failed = {row["name"] for row in report["steps"] if row["outcome"] == "failed"}
    assert failed <= TIMES, report["steps"]
    if not failed:
        assert report["verdict"] == "sound"
    pulses = bench.fault(cmd="pulses")["pulses"]
    assert all(one["width_us"] <= 100.0 and one["current_ma"] == 16.0 for one in pulses), "less after a pause"


def test_a_fault_of_a_wire_is_told(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench("--noise-seed", "7", "--fault", "wrong_bit_rate")
    code, report = checked(bench)
    assert (code, report["verdict"]) == (1, "faults")
    assert [row["fault"] for row in report["steps"] if row["fault"]] == ["bit_rate"]
    assert bench.fault(cmd="pulses")["pulses"] == []
