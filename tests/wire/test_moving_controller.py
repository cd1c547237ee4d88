"""`examples/ilc_moving_joint.py` from end to end: an arm that is moved when a trial begins, and what is recorded of it.

How well it tracks is not judged here (`tests/examples/test_ilc_moving_joint.py`, `bench.ilc_moving_joint`).
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.api.cli.launcher import Services
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings
from tests.harness.processes import control

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

ROOT = Path(__file__).parents[2]
TOKEN = "administrator-token-of-a-moving-joint"
SPEED, PULSES = 2.0, 260
"""A machine that pauses for a second begins the movement two seconds late: it is still in the trial."""
LOW_DEG, HIGH_DEG = 70.0, 110.0
WAY = [[0, LOW_DEG], [0.1, LOW_DEG], [1.6, HIGH_DEG], [3.1, LOW_DEG], [3.2, LOW_DEG]]
OUT_AND_BACK = {"cmd": "arm", "mode": "script", "points": WAY}
"""Level at both ends: it comes to rest where the next one begins."""
SWEEPS = {"cmd": "arm", "mode": "robot", "from_deg": 50.0, "to_deg": 130.0, "deg_s": 50.0}
HELD = {"cmd": "arm", "mode": "held", "angle_deg": LOW_DEG}
WIDTHS = [0.0] * 40 + [50.0, 100.0] + [140.0] * 160 + [180.0] + [220.0] * 160 + [0.0] * 40


PROFILE = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_torque_nm": 30.0, "angle_range_rad": [0.7, 2.5]}


def trial(client: Client, widths_us: list[float]) -> dict[str, Any]:
    """A list of widths, played to its end."""
    segments = [{"name": "steps", "sequence": "widths", "settings": {"pulse_width_us": widths_us}}]
    *_, ended = client.follow(client.start_test("P", kind="sequence", segments=segments)["id"])
    assert ended["state"] == "completed", ended["reason"]
    return ended


def identified(client: Client, socket: str) -> str:
    """The model of a pre-session test at rest and of steps while a robot sweeps the joint; approved."""
    client.make_participant("P", PROFILE)
    still = client.run_test("P")["recording_id"]
    assert control(socket, SWEEPS)["ok"]
    swept = trial(client, WIDTHS)["recording_id"]
    assert control(socket, HELD)["ok"]
    model = client.post("/v1/participants/P/models", json={"recordings": [still, swept]})["id"]
    client.approve(model, "a test")
    return model


def learnt(url: str, folder: Path, socket: str) -> subprocess.CompletedProcess[str]:
    """Two trials of the example, as a person would start it."""
    turn = np.clip(np.arange(PULSES) / 40 / 3.2, 0, 1)
    path, begin = folder / "angles.csv", folder / "begin.py"
    np.savetxt(path, np.radians(LOW_DEG + (HIGH_DEG - LOW_DEG) * np.sin(np.pi * turn) ** 2))
    begin.write_text(
        f"import socket\nline = socket.socket(socket.AF_UNIX)\nline.connect({str(socket)!r})\n"
        f"line.sendall({json.dumps(OUT_AND_BACK).encode()!r} + b'\\n')\nassert b'true' in line.recv(1000)\n"
    )
    command = [
        sys.executable, ROOT / "examples" / "ilc_moving_joint.py", "--url", url, "--participant", "P", "--movement",
        path, "--start", f"{sys.executable} {begin}", "--trials", "2",
    ]  # fmt: skip
    environment = {**os.environ, "STIMRIG_TOKEN": TOKEN}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)


def test_the_joint_is_moved_in_each_trial_and_its_angle_is_learnt_from(tmp_path: Path) -> None:
    options = ["--arm", f"held,angle_deg={LOW_DEG:g}", "--noise-seed", "4", "--speed", f"{SPEED:g}"]
    settings = Settings(data_dir=tmp_path / "data")
    settings.port = 0
    with Services(settings, options, TOKEN) as services, Client(services.url, TOKEN, timeout_s=300) as client:
        assert services.emulator is not None
        socket = services.emulator.ready["control"]
        model = identified(client, socket)
        document = client.model_file(model)
        assert document["joint"]["velocity_rad_s"][-1] > 0.5, "g and h, seen in motion"
        done = learnt(services.url, tmp_path, socket)
        assert done.returncode == 0, done.stderr
        assert f"model {document['model_id']} with g and h" in done.stdout
        errors = [float(line.split()[1]) for line in done.stdout.splitlines()[1:]]
        assert len(errors) == 2 and np.all(np.isfinite(errors))
        tests = [test for test in client.get("/v1/tests") if test["kind"] == "sequence"][:2]
        for test in tests:
            with h5py.File(io.BytesIO(client.recording(test["recording_id"]))) as file:
                time_s, angle_deg = file["angle/time_s"][:], np.degrees(file["angle/angle_rad"][:])
            assert angle_deg.max() > HIGH_DEG - 3 and abs(angle_deg[time_s < 0.9] - LOW_DEG).max() < 2, "not before it"
