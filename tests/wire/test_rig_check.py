"""The check on the wire, as `stimrig rig check` starts it: real ports, an emulator, a person's answers on a pipe."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from tests.harness.processes import ROOT, Bench

pytestmark = pytest.mark.wire
ANSWERS = "no\nyes\n"
"""Nobody pulls at the emulator's lever; the dummy load is there."""


def started(bench: Bench, *module: str) -> subprocess.Popen[str]:
    words = ["--emulator-json", json.dumps(bench.emulator.ready), "--data", str(bench.data)]
    return subprocess.Popen(
        [sys.executable, "-m", *module, *words],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_one_small_pulse_where_a_person_says_yes(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench("--noise-seed", "7", "--stimulator", "rehastim2")
    out, err = started(bench, "stimrig.rig.check").communicate(ANSWERS, timeout=120)
    report = json.loads(out)
    outcomes = {step["name"]: step["outcome"] for step in report["steps"]}
    assert outcomes.pop("sign of the torque") == "not done", err
    pulses = bench.fault(cmd="pulses")["pulses"]
    pulse = next(step for step in report["steps"] if step["name"] == "test pulse")
    if "DROPPED" in pulse["figure"]:  # the machine stood still while it was due
        assert pulses == []
        return
    assert [(one["width_us"], one["current_ma"]) for one in pulses] == [(100.0, 16.0)], err
    assert set(outcomes.values()) == {"passed"} and report["verdict"] == "incomplete", err


@pytest.mark.parametrize(
    ("module", "end"), [(["stimrig.rig.check"], signal.SIGINT), (["stimrig", "rig", "check"], signal.SIGKILL)]
)
def test_ctrl_c_stops_the_stimulator(make_bench: Callable[..., Bench], module: list[str], end: int) -> None:
    """And so does the end of the command that started the check."""
    bench = make_bench("--noise-seed", "7")
    process = started(bench, *module)
    assert process.stdin is not None
    process.stdin.write(ANSWERS)
    process.stdin.flush()
    end_s = time.monotonic() + 60
    while bench.state()["mode"] == "none":  # until the stimulator is made ready for the pulse
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
    assert bench.state()["pulses_received"] == pulses <= 1
