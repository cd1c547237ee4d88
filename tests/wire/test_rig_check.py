"""The check on the wire, as `stimrig rig check` starts it: real ports, the emulator's hands, the report on disk."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.harness.processes import ROOT, Bench

pytestmark = pytest.mark.wire
TIMES = {
    "pulses_dropped", "answers_late", "computer_busy", "torque_stale", "pulse_unanswered", "torque_unseen", "stop_late",
    "frames_dropped", "clock_off",
}  # fmt: skip
"""What a busy machine may be told of by itself; what comes after is then not done."""


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
    told = {row["fault"]: row["figure"] for row in report["steps"] if row["fault"]}
    assert set(told) <= TIMES, told
    if not told:
        assert report["verdict"] == "sound"
    pulses = bench.fault(cmd="pulses")["pulses"]
    assert all(one["width_us"] <= 100.0 and one["current_ma"] == 16.0 for one in pulses), "less after a pause"


def test_a_fault_of_a_wire_is_told(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench("--noise-seed", "7", "--fault", "wrong_bit_rate")
    code, report = checked(bench)
    assert (code, report["verdict"]) == (1, "faults")
    assert [row["fault"] for row in report["steps"] if row["fault"]] == ["bit_rate"]
    assert bench.fault(cmd="pulses")["pulses"] == []


@pytest.mark.parametrize(
    ("module", "end"), [(["stimrig.rig.check"], signal.SIGINT), (["stimrig", "rig", "check"], signal.SIGKILL)]
)
def test_ctrl_c_stops_the_stimulator(make_bench: Callable[..., Bench], module: list[str], end: int) -> None:
    """And so does the end of the command that started the check."""
    bench = make_bench("--noise-seed", "7")
    command = [
        "-m",
        *module,
        "--emulator-json",
        json.dumps(bench.emulator.ready),
        "--data",
        str(bench.data),
    ]
    process = subprocess.Popen(
        [sys.executable, *command, "--answer", "weight_on=no"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    end_s = time.monotonic() + 60
    while len(bench.fault(cmd="pulses")["pulses"]) < 5:
        assert process.poll() is None and time.monotonic() < end_s, process.communicate()
        time.sleep(0.02)
    process.send_signal(end)
    out, err = process.communicate(timeout=60)  # until the check itself has ended, too
    assert (process.returncode, out) == (130 if end == signal.SIGINT else -end, ""), err
    assert err.strip().splitlines()[-1] == "check: interrupted; the stimulator was stopped"
    state = bench.state()
    assert state["mode"] == "none", "it was told to stop, not only left alone"
    pulses = state["pulses_received"]
    time.sleep(0.3)
    assert bench.state()["pulses_received"] == pulses
