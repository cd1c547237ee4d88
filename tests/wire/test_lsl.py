"""Lab Streaming Layer on the emulated rig: what a recorder gets is what is sealed, and the rig goes on without it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.harness.lsl_recorder import Streams, compare, on_this_machine
from tests.harness.processes import ROOT, Bench, RigClient, short_plan

pytest.importorskip("pylsl", reason="LSL is not installed: pip install stimrig[lsl]", exc_type=Exception)
pytestmark = [pytest.mark.wire, pytest.mark.slow]


LONG = [{"name": "ramp", "sequence": "ramp", "settings": {"up_s": 6.0, "down_s": 6.0}}]
"""A test that goes on until outlets that are started in it are there, on a busy machine, too."""


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    bench = make_bench("--noise-seed", "7", "--clock-ppm", "150", speed=1.0)
    bench.start_rig()
    return bench


@pytest.fixture(autouse=True)
def quiet(tmp_path: Path) -> Iterator[None]:
    with on_this_machine(tmp_path):
        yield


@pytest.fixture
def streams(bench: Bench) -> Iterator[Streams]:
    with Streams(bench, "test") as streams:
        yield streams


def played(client: RigClient, plan: dict) -> dict:
    reply = client.start(plan)
    assert reply["ok"], reply
    return client.wait_finished(plan["test_id"])


def test_a_recorder_gets_what_is_sealed(bench: Bench, streams: Streams):
    """Tests after one another, of which one is stopped; the recorder was there before the first."""
    client = bench.client()
    client.ask("subscribe")
    first = played(client, short_plan("first"))
    assert client.start(short_plan("second"))["ok"]
    client.wait_state("running")
    time_s = client.status()["elapsed_s"]
    while client.status()["elapsed_s"] < time_s + 2.0:
        time.sleep(0.05)
    client.ask("stop", reason="enough", by="test")
    second = client.wait_finished("second")
    streams.wait_sent("second")
    recorded = streams.end()
    for event in (first, second):
        found = compare(recorded, event["recording_path"])
        assert np.median(found.torque_apart_s) < 5e-3
        assert np.median(found.pulses_apart_s) < 5e-3
        assert found.samples_more < 60
    marks = [json.loads(mark) for mark in recorded["tests"]]
    assert [(mark["event"], mark["test_id"]) for mark in marks] == [
        (event, test_id) for test_id in ("first", "second") for event in ("start", "end")
    ]
    assert marks[1]["outcome"] == "completed" and marks[3]["outcome"] == "stopped"
    assert marks[1]["recording_id"] == first["recording_id"]
    check_description(streams.recorder.info)


def check_description(info: dict[str, str]) -> None:
    """Rates, units and labels, as LabRecorder keeps them."""
    torque, pulses = ET.fromstring(info["torque"]), ET.fromstring(info["pulses"])
    assert float(torque.findtext("nominal_srate") or 0) == 1600.0
    assert float(pulses.findtext("nominal_srate") or -1) == 0.0
    assert [c.findtext("unit") for c in torque.iterfind("desc/channels/channel")] == ["N·m"]
    channels = [(c.findtext("label"), c.findtext("unit")) for c in pulses.iterfind("desc/channels/channel")]
    assert channels == [("pulse_width", "µs"), ("current", "mA"), ("index", "1")]
    assert torque.findtext("desc/load_cell") == "can_load_cell"


def test_killed_and_started_again_in_a_test_nothing_is_doubled_and_the_rig_does_not_notice(
    bench: Bench, streams: Streams
):
    client = bench.client()
    client.ask("subscribe")
    assert client.start(short_plan("one", segments=LONG))["ok"]
    client.wait_state("running")
    streams.started[0].stop(signal.SIGKILL)
    streams.start()
    event = client.wait_finished("one")
    assert event["outcome"] == "completed", event["reason"]
    assert event["summary"]["lost_samples"] == 0
    streams.wait_sent("one")
    recorded = streams.end()
    index = recorded["pulses"][:, 2]
    assert len(np.unique(index)) == len(index)
    assert "joins one.journal" in streams.started[1].log.read_text()
    assert len(np.unique(recorded["torque"])) > 0.99 * len(recorded["torque"]) > 0
    assert np.all(np.diff(recorded["torque_s"]) >= 0)


def ended(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "stimrig.rig.lsl_outlets", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=60, env={**os.environ, **environment}
    )


@pytest.mark.parametrize("arguments", [("--data", "/nowhere"), ("--config", "/nowhere.toml")])
def test_what_is_wrong_is_one_line(arguments: tuple[str, ...]):
    done = ended(*arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("lsl: "), done.stderr
    assert "Traceback" not in done.stderr


def test_without_the_library_it_is_one_line(tmp_path: Path):
    done = ended("--data", str(tmp_path), PYTHONPATH=str(without_pylsl(tmp_path)))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "stimrig[lsl]" in done.stderr, done.stderr


def without_pylsl(folder: Path) -> Path:
    (folder / "hidden").mkdir()
    (folder / "hidden" / "pylsl.py").write_text("raise ImportError('no library here')\n")
    return folder / "hidden"
