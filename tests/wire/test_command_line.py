"""`python -m stimrig.rig` and `stimrig rig check`: mistakes are one line and exit 2, and an interrupted check stops."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stimrig.rig import __main__ as program
from tests.harness.processes import ROOT, Bench, Process, RigClient, later

pytestmark = pytest.mark.wire

CONFIG = """
data_dir = "{folder}/data"
socket = "{folder}/rig.sock"
[stimulator]
device = "p24"
port = "{folder}/no-such-port"
[load_cell]
device = "can_load_cell"
bus = {{ interface = "socketcand", host = "127.0.0.1", port = 9, channel = "can0" }}
"""
ANSWERS = "no\nyes\n"
"""Nobody pulls at the emulator's lever; the dummy load is there."""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command's exit code, in this process and without its log."""
    monkeypatch.setattr(program.logs, "configure", lambda *_: None)
    return lambda *arguments: program.main([str(argument) for argument in arguments])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [("/data", "/rig.toml/data", "data_dir"), ("{folder}/rig.sock", "{folder}/" + "x" * 120, "socket")],
)
def test_a_mistake_is_one_line_and_exit_2(
    tmp_path: Path, run: Callable[..., int], capsys: pytest.CaptureFixture[str], old: str, new: str, words: str
):
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG.replace(old, new).format(folder=tmp_path))
    assert run("--config", path) == 2
    output, errors = capsys.readouterr()
    assert (output, errors.count("\n")) == ("", 1) and words in errors


def test_check_reads_the_file_and_the_dbc_only(
    tmp_path: Path, run: Callable[..., int], capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG.format(folder=tmp_path))
    assert run("--config", path, "--check") == 0
    assert json.loads(capsys.readouterr().out)["stimulator"] == "p24"


def test_a_port_that_is_not_there_is_told_until_it_is(emulator: Bench, tmp_path: Path):
    link = tmp_path / "no-such-port"
    path = tmp_path / "rig.toml"
    path.write_text(
        CONFIG.format(folder=tmp_path).replace("port = 9", f"port = {emulator.emulator.ready['can']['port']}")
    )
    rig = Process("stimrig.rig", "--config", str(path), log=tmp_path / "rig.log")
    try:
        assert rig.ready["state"] == "disconnected"
        client = RigClient(tmp_path / "rig.sock")
        assert "no-such-port is missing" in client.status()["reason"]
        assert client.rearm("nurse")["problem"]["code"] == "disconnected"
        link.symlink_to(emulator.emulator.ready["stimulator"])
        assert client.rearm("nurse")["body"]["state"] == "ready"
        client.close()
    finally:
        assert rig.stop() == 0


def check(bench: Bench, folder: Path, *module: str) -> subprocess.Popen[str]:
    words = ["--emulator-json", json.dumps(bench.emulator.ready), "--data", str(folder / "data")]
    return subprocess.Popen(
        [sys.executable, "-m", *module, *words],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_one_small_pulse_where_a_person_says_yes(emulator: Bench, tmp_path: Path) -> None:
    before = len(emulator.felt())
    out, err = check(emulator, tmp_path, "stimrig.rig.check").communicate(ANSWERS, timeout=120)
    report = json.loads(out)
    outcomes = {step["name"]: step["outcome"] for step in report["steps"]}
    assert outcomes.pop("sign of the torque") == "not done", err
    pulses = emulator.felt()[before:]
    pulse = next(step for step in report["steps"] if step["name"] == "test pulse")
    if "DROPPED" in pulse["figure"]:  # the machine stood still while it was due
        assert pulses == []
        return
    assert [(one["width_us"], one["current_ma"]) for one in pulses] == [(100.0, 16.0)], err
    assert set(outcomes.values()) == {"passed"} and report["verdict"] == "incomplete", err


@pytest.mark.parametrize(
    ("module", "end"), [(["stimrig.rig.check"], signal.SIGINT), (["stimrig", "rig", "check"], signal.SIGKILL)]
)
def test_ctrl_c_stops_the_stimulator(emulator: Bench, tmp_path: Path, module: list[str], end: int) -> None:
    """And so does the end of the command that started the check."""
    before = emulator.state()["pulses_received"]
    process = check(emulator, tmp_path, *module)
    assert process.stdin is not None
    process.stdin.write(ANSWERS)
    process.stdin.flush()
    end_s = time.monotonic() + 60
    while emulator.state()["mode"] == "none":  # until the stimulator is made ready for the pulse
        assert process.poll() is None and time.monotonic() < end_s, process.communicate()
        time.sleep(0.02)
    process.send_signal(end)
    out, err = process.communicate(timeout=60)  # until the check itself has ended, too
    assert (process.returncode, out) == (130 if end == signal.SIGINT else -end, ""), err
    assert err.strip().splitlines()[-1] == "check: interrupted; the stimulator was stopped"
    state = emulator.state()
    assert state["mode"] == "none", "it was told to stop, not only left alone"
    assert later(emulator)["pulses_received"] == state["pulses_received"] <= before + 1
