"""`python -m stimrig.rig`: mistakes are one line and exit 2; what is not there yet is a state, not a mistake."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.harness.processes import ROOT, Bench, Process, RigClient

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


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "stimrig.rig", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"p24"', '"p23"', "stimulator.device: unknown device 'p23'; use one of: p24"),
        ("/data", "/rig.toml/data", "data_dir"),
        ("{folder}/rig.sock", "{folder}/" + "x" * 120, "socket"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(tmp_path: Path, old: str, new: str, words: str):
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG.replace(old, new).format(folder=tmp_path))
    ended = run("--config", str(path))
    assert ended.returncode == 2
    lines = [line for line in ended.stderr.splitlines() if not line.startswith("{")]  # beside the log
    assert len(lines) == 1
    assert words in lines[0]
    assert "Traceback" not in ended.stderr
    assert ended.stdout == ""


def test_check_reads_the_file_and_the_dbc_only(tmp_path: Path):
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG.format(folder=tmp_path))
    ended = run("--config", str(path), "--check")
    assert ended.returncode == 0
    assert json.loads(ended.stdout)["stimulator"] == "p24"


def test_the_rig_ends_with_its_parent_where_asked(bench: Bench, tmp_path: Path):
    launcher = (
        "import subprocess, sys; p = subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE); "
        "print(p.stdout.readline()); print(p.pid)"
    )
    options = ["--data", str(tmp_path / "data"), "--socket", str(tmp_path / "rig.sock"), "--die-with-parent"]
    rig = [sys.executable, "-m", "stimrig.rig", "--emulator-json", json.dumps(bench.emulator.ready), *options]
    done = subprocess.run([sys.executable, "-c", launcher, *rig], cwd=ROOT, capture_output=True, text=True, timeout=30)
    pid = int(done.stdout.split()[-1])
    end = time.monotonic() + 10
    while Path(f"/proc/{pid}").exists() and " Z " not in Path(f"/proc/{pid}/stat").read_text():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_port_that_is_not_there_is_told_until_it_is(make_bench: Callable[..., Bench], tmp_path: Path):
    bench = make_bench("--noise-seed", "7")
    link = tmp_path / "no-such-port"
    can = bench.emulator.ready["can"]
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG.format(folder=tmp_path).replace("port = 9", f"port = {can['port']}"))
    rig = Process("rig", "--config", str(path), log=tmp_path / "rig.log")
    try:
        assert rig.ready["state"] == "disconnected"
        client = RigClient(tmp_path / "rig.sock")
        assert "no-such-port is missing" in client.status()["reason"]
        assert client.rearm("nurse")["problem"]["code"] == "disconnected"
        link.symlink_to(bench.emulator.ready["stimulator"])
        assert client.rearm("nurse")["body"]["state"] == "ready"
        client.close()
    finally:
        assert rig.stop() == 0
