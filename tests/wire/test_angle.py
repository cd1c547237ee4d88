"""The joint's angle over the wire: aligned, calibrated, recorded; faults end a test, and a passive one has no pulse."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.rig import archive
from tests.harness.processes import Bench, RigClient, default_plan, made_ready

pytestmark = [pytest.mark.wire, pytest.mark.slow]

PPM = 150.0
MOUNTED = ("--angle-offset-deg", "31.5", "--angle-direction", "-1")
CLOCK = ("--angle-clock-ppm", f"{PPM:g}", "--angle-jitter-us", "200")
MOVING = {"cmd": "arm", "mode": "robot", "from_deg": 30.0, "to_deg": 100.0, "deg_s": 40.0}
PLAN = {"kind": "passive", "angle": {"range_rad": [0.2, 2.2], "still_s": 2.0}}
STEPS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
    {"name": "steps", "sequence": "steps", "settings": {"on_s": 2.5, "off_s": 1.0, "repeats": 1}},
]
REST = [{"name": "passive", "sequence": "rest", "settings": {"duration_s": 3.0}}]


@pytest.fixture(scope="module")
def angled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, RigClient]]:
    """An arm with its sensor, and a rig, for the whole file."""
    bench = Bench(tmp_path_factory.mktemp("angled"), "--arm", "held", "--noise-seed", "7", *MOUNTED, *CLOCK)
    yield bench, bench.start_rig()
    bench.close()


@pytest.fixture
def ready(angled: tuple[Bench, RigClient]) -> tuple[Bench, RigClient]:
    """The file's pair, ready and at 60 degrees."""
    bench, client = made_ready(*angled)
    at(bench, client, 60.0)
    return bench, client


def at(bench: Bench, client: RigClient, degrees: float) -> None:
    """Hold the arm there until the rig sees it."""
    assert bench.fault(cmd="arm", mode="held", angle_deg=degrees)["ok"]
    end = time.monotonic() + 60
    while True:
        raw = client.status()["angle"]
        still = raw["velocity_rad_s"] is not None and abs(raw["velocity_rad_s"]) < 0.1
        if still and abs(math.degrees(raw["angle_rad"]) - degrees) < 2.0:
            return
        assert time.monotonic() < end, raw
        time.sleep(0.05)


def test_a_passive_test_records_angles_within_a_millisecond_of_the_torque_and_no_pulse(ready: tuple[Bench, RigClient]):
    bench, client = ready
    assert bench.fault(**MOVING)["ok"]
    before = bench.state()["pulses_received"]
    refused = client.ask("start", plan=default_plan("wide", **PLAN, segments=STEPS))
    assert "passive test" in refused["problem"]["detail"]
    client.ask("subscribe")
    reply = client.start(default_plan("passive", **PLAN, segments=REST))
    assert reply["ok"], reply
    event = client.wait_finished("passive")
    assert event["outcome"] == "completed", event
    assert bench.state()["pulses_received"] == before
    path = Path(event["recording_path"])
    assert archive.verify(path)
    with h5py.File(path) as file:
        group, torque = file["angle"], file["torque"]
        assert group.attrs["method"] in ("order", "stamps")
        time_s, number = group["time_s"][:], group["counter"][:]
        assert np.degrees(group["angle_rad"][:].min()) == pytest.approx(30.0, abs=2.0)
        assert np.degrees(group["angle_rad"][:].max()) == pytest.approx(100.0, abs=2.0)
        assert np.percentile(np.abs(np.degrees(group["velocity_rad_s"][:])), 90) == pytest.approx(40.0, abs=2.0)
        assert np.allclose(np.degrees(group["angle_rad"][:]), -(group["raw"][:] - 31.5), atol=1e-9)
        # both counters began when the emulator did, and neither has wrapped
        sampled = number * 8.0 / (1 + PPM * 1e-6)
        true_s = np.interp(sampled, torque["counter"][:], torque["time_s"][:])
        assert np.max(np.abs(time_s - true_s)[20:-20]) < 1e-3
    record = identify.read(path)
    assert record.angle_rad is not None and record.velocity_rad_s is not None


def test_a_sensor_that_is_plugged_in_again_is_found_by_itself(ready: tuple[Bench, RigClient]):
    bench, client = ready
    assert bench.fault(cmd="fault", name="angle_unplugged", on=True)["ok"]
    end = time.monotonic() + 60
    while not client.status()["angle"]["problem"]:
        assert time.monotonic() < end
        time.sleep(0.05)
    assert bench.fault(cmd="fault", name="angle_unplugged", on=False)["ok"]
    at(bench, client, 60.0)
    assert client.status()["angle"]["problem"] == ""
