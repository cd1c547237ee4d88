"""The emulator as a process: start, ready line, signals, bad input, its parent's death."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stimrig.hardware_sim.__main__ import main
from tests.hardware_sim.emulated import emulated, wait_for
from tests.harness.processes import ROOT, alive

pytestmark = pytest.mark.wire


def test_the_ready_line_and_the_speed_of_the_emulators_time() -> None:
    """The time between two answers lies between the shortest and the longest that the asker can have seen."""
    with emulated("--noise-seed", "3", "--rate-hz", "800", "--speed", "10") as rig:
        ready = rig.ready
        assert Path(ready["stimulator"]).is_char_device()
        assert Path(ready["stimulator_link"]).resolve() == Path(ready["stimulator"])
        assert set(ready["can"]) == {"interface", "host", "port", "channel"}
        wanted = {"pid": rig.popen.pid, "sample_rate_hz": 800.0, "speed": 10.0, "patient": "paper", "noise_seed": 3}
        assert {key: ready[key] for key in wanted} == wanted
        asked_s, before, told_s = time.monotonic(), rig.ask(cmd="state"), time.monotonic()
        time.sleep(0.2)
        again_s, after, end_s = time.monotonic(), rig.ask(cmd="state"), time.monotonic()
        passed_s = after["time_s"] - before["time_s"]
        assert 10 * (again_s - told_s) <= passed_s <= 10 * (end_s - asked_s)
        assert after["samples"] - before["samples"] == pytest.approx(800 * passed_s, abs=2)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly(number: signal.Signals) -> None:
    with emulated() as rig:
        rig.popen.send_signal(number)
        output, _ = rig.popen.communicate(timeout=30)
        assert (rig.popen.returncode, output, rig.log.read_text()) == (0, "", "")
    assert not Path(rig.ready["control"]).parent.exists()


def test_it_ends_with_its_parent() -> None:
    start = "subprocess.Popen([sys.executable, '-m', 'stimrig.hardware_sim', '--die-with-parent'])"
    code = f"import subprocess, sys, time\n{start}\ntime.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = json.loads(parent.stdout.readline())["pid"]
    parent.kill()
    parent.wait()
    wait_for(lambda: not alive(child))
    parent.stdout.close()


def test_patient_file_and_faults(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('patient = "changing"\n[parameters]\nlargest_nm = 4.0\n')
    faults = "--fault", "torque_saturated,limit_nm=0.01", "--fault", "no_ack"
    with emulated("--patient", str(path), *faults) as rig:
        assert rig.ready["patient"] == str(path)
        assert rig.ask(cmd="state")["faults"] == ["no_ack", "torque_saturated"]


BAD_INPUT = {
    "--patient nobody": "changing, paper",
    "--patient nobody.toml": "nobody.toml: cannot be read",
    "--noise-nm much": "--noise-nm",
    "--noise-nm nan": "--noise-nm must be between 0 and 10",
    "--rate-hz 0": "--rate-hz must be between",
    "--speed inf": "--speed must be between",
    "--clock-jitter-us -1": "--clock-jitter-us must be between",
    "--load-cell usb": "slcan",
    "--stimulator rehastim3": "rehastim2",
    "--fault earthquake": "unknown fault 'earthquake'",
    "--fault late_ack,delay_s=long": "SETTING=NUMBER",
    "--fault late_ack,delay=1": "no setting 'delay'; it has delay_s",
    "--hidden x": "--hidden",
    "--hidden -5": "give a seed of 0 or above",
    "--patient /dev/zero": "neither a file nor one of",
    "--samples-per-frame 2": "--samples-per-frame must be 1 or 3 with --cell plain, not 2",
    "--cell canopen --samples-per-frame 3": "must be 1 with --cell canopen",
    "--wrong": "--wrong",
    "--arm fly": "unknown mode of the arm 'fly'",
    "--arm held,angle_deg=ten": "'angle_deg=ten' must be SETTING=NUMBER",
    "--arm held --angle-bits 30": "--angle-bits must be between 8 and 20",
    "--arm held --angle-noise-deg nan": "--angle-noise-deg must be between",
    "--arm held --angle in-cell --cell plain": "--cell with_angle goes with",
    "--cell with_angle": "--cell with_angle goes with",
    "--arm held --arm-law passive=jelly": "unknown law of passive 'jelly'",
    "--arm held --arm-law passive=linear_friction,dry_nm=much": "must be SETTING=NUMBER",
    "--hidden 1 --arm held --arm-law passive=none": "is hidden, too",
}


@pytest.mark.parametrize(("arguments", "told"), BAD_INPUT.items())
def test_bad_input_is_one_line_and_exit_2(arguments: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments.split()) == 2
    output, errors = capsys.readouterr()
    assert (output, errors.count("\n")) == ("", 1)
    assert told in errors


def test_bad_input_ends_the_process_with_2() -> None:
    command = [sys.executable, "-m", "stimrig.hardware_sim", "--wrong"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_stopped_and_continued_it_catches_up() -> None:
    with emulated() as rig:
        rig.popen.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        rig.popen.send_signal(signal.SIGCONT)
        state = rig.ask(cmd="state")
        assert state["samples"] == pytest.approx(1600 * state["time_s"], abs=2)
