"""Stops and faults over the wire: stimulation ends, the reason is told, the rig stays latched, nothing is lost."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig import archive
from stimrig.rig.config import EMULATOR_WATCH
from tests.harness.processes import Bench, RigClient, default_plan, kill_hard, short_plan

pytestmark = pytest.mark.wire

RATE_HZ = 40.0
FAULTS = {"electrode_error": "electrode error", "cell_silent": "stale", "stimulator_unplugged": "stimulator"}


STEPS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.4}},
    {"name": "steps", "sequence": "steps", "settings": {"on_s": 30.0, "off_s": 0.0}},
]


def start(bench: Bench, test_id: str = "t", client: RigClient | None = None) -> RigClient:
    """A test that runs, its first pulses felt."""
    client = client or bench.start_rig()
    client.ask("subscribe")
    before = bench.state()["pulses_received"]
    reply = client.start(default_plan(test_id, segments=STEPS))
    assert reply["ok"], reply
    client.wait_state("running")
    end = time.monotonic() + 60
    while bench.state()["pulses_received"] < before + 30:
        assert time.monotonic() < end, client.status()
        time.sleep(0.02)
    return client


def later(bench: Bench) -> dict[str, Any]:
    """What the emulator says half a second of its own time later."""
    began_s = bench.state()["time_s"]
    end = time.monotonic() + 60
    while (state := bench.state())["time_s"] < began_s + 0.5:
        assert time.monotonic() < end
        time.sleep(0.02)
    return state


def check_kept(event: dict[str, Any], outcome: str) -> None:
    """The part that was played is sealed and readable."""
    assert event["outcome"] == outcome
    path = Path(event["recording_path"])
    with h5py.File(path) as file:
        assert file.attrs["outcome"] == outcome
        assert file.attrs["reason"]
        assert archive.verify(path) == file.attrs["content_sha256"]
        assert np.sum(file["pulses/status"][:] == 0) >= 15
        assert len(file["torque/time_s"]) > 1000


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_stops_is_told_and_latches(shared: tuple[Bench, RigClient], fault: str):
    bench, client = shared
    start(bench, fault, client)
    injected = bench.fault(cmd="fault", name=fault, on=True)
    assert injected["ok"], injected
    counted = bench.state()["pulses_received"]
    event = client.wait_finished(fault, timeout_s=60)
    check_kept(event, "fault")
    assert FAULTS[fault] in event["reason"]
    # pulses are counted, not seconds: a computer that stands still sends none
    watch_s = EMULATOR_WATCH["stale_torque_s"] if fault == "cell_silent" else 0.0
    assert bench.state()["pulses_received"] - counted <= RATE_HZ * (watch_s + 0.25)
    status = client.wait_state("latched")
    # what the reader of a silent or unplugged device finds after the end comes behind
    rest = status["reason"].removeprefix(event["reason"])
    assert rest != status["reason"]
    assert not rest or fault in ("stimulator_unplugged", "cell_silent"), status["reason"]
    refused = client.ask("start", plan=short_plan("refused"))
    assert refused["problem"]["code"] == "latched"
    bench.fault(cmd="fault", name=fault, on=False)
    later(bench)
    rearmed = client.rearm("nurse")
    assert rearmed["ok"], rearmed
    assert rearmed["body"]["state"] == "ready"


@pytest.mark.parametrize("fault", ["cell_silent", "torque_stuck", "bus_off", "error_frames"])
def test_a_load_cell_that_fails_before_the_start_is_told_before_the_first_pulse(
    shared: tuple[Bench, RigClient], fault: str
):
    bench, client = shared
    client.ask("subscribe")
    before = bench.state()["pulses_received"]
    assert bench.fault(cmd="fault", name=fault, on=True)["ok"]
    test_id = f"{fault}-before"
    reply = client.start(default_plan(test_id, segments=STEPS))
    if reply["ok"]:
        assert client.wait_finished(test_id, timeout_s=60)["outcome"] == "fault"
    # also where the rest between two tests left the rig the time to find it silent
    reason = client.status()["reason"] if reply["ok"] else reply["problem"]["detail"]
    assert "load cell" in reason and "look at its plug and supply, and at the CAN adapter" in reason, reply
    assert bench.state()["pulses_received"] == before
    bench.fault(cmd="fault", name=fault, on=False)
    later(bench)
    assert client.rearm("nurse")["body"]["state"] == "ready"


def test_a_load_cell_that_is_unplugged_and_comes_back_elsewhere(bench: Bench):
    client = start(bench, "unplugged")
    assert bench.fault(cmd="fault", name="cell_unplugged", on=True)["ok"]
    check_kept(client.wait_finished("unplugged"), "fault")
    bench.fault(cmd="fault", name="cell_unplugged", on=False)  # under another port
    assert client.rearm("nurse")["problem"]["code"] == "disconnected"
    assert client.ask("start", plan=short_plan("refused"))["problem"]["code"] == "latched"


def test_stop_is_confirmed_by_device_and_torque(shared: tuple[Bench, RigClient]):
    bench, client = shared
    start(bench, "t", client)
    other = bench.client()
    evidence = other.ask("stop", reason="participant asks", by="nurse")["body"]
    assert evidence["confirmed"], evidence
    assert evidence["device_state"] == "not initialised"
    assert "torque fell" in evidence["detail"] or "near rest" in evidence["detail"]
    count = bench.state()["pulses_received"]
    event = client.wait_finished("t")
    check_kept(event, "stopped")
    assert "participant asks (by nurse)" in event["reason"]
    assert later(bench)["pulses_received"] == count
    assert client.wait_state("latched")["reason"] == "participant asks (by nurse)"
    assert client.rearm("nurse")["body"]["state"] == "ready"


def test_a_signal_stops_stimulation_first_and_seals(bench: Bench):
    start(bench)
    assert bench.rig is not None
    assert bench.rig.stop(signal.SIGTERM, timeout_s=120.0) == 0
    count = bench.state()["pulses_received"]
    assert later(bench)["pulses_received"] == count
    sealed = list((bench.data / "recordings").glob("*.h5"))
    assert len(sealed) == 1
    with h5py.File(sealed[0]) as file:
        assert file.attrs["outcome"] == "stopped"
    client = bench.start_rig()  # what stopped it is remembered
    assert client.status()["state"] == "latched"
    assert "shutting down" in client.status()["reason"]


def test_a_killed_rig_sends_no_more_and_comes_back_uncertain(bench: Bench):
    start(bench, "killed")
    assert bench.rig is not None
    kill_hard(bench.rig)
    killed_s = bench.state()["time_s"]
    count = later(bench)["pulses_received"]
    # silence is no stimulation; one command may have been on its way
    assert sum(pulse["time_s"] > killed_s for pulse in bench.felt()) <= 1
    client = bench.start_rig()
    status = client.status()
    assert status["state"] == "uncertain"
    assert "killed" in status["reason"]
    event = status["finished"]
    check_kept(event, "fault")
    with h5py.File(event["recording_path"]) as file:
        acknowledged = int(np.sum(file["pulses/status"][:] == 0))
        assert acknowledged >= count - 2  # the last ack may have been on its way
        assert np.sum(np.isfinite(file["pulses/sent_pulse_width_us"][:]) & (file["pulses/status"][:] != 1)) >= count
    felt = bench.felt()
    felt_uc = sum(pulse["width_us"] * pulse["current_ma"] * 1e-3 for pulse in felt)
    summary = event["summary"]
    most_uc = max(pulse["width_us"] * pulse["current_ma"] * 1e-3 for pulse in felt)
    assert felt_uc - 1e-6 <= summary["charge_uc"] <= felt_uc + most_uc + 1e-6  # one may not have left
    assert len(felt) <= summary["pulses"] <= len(felt) + 1
    assert summary["duration_s"] >= felt[-1]["time_s"] - felt[0]["time_s"] > 0
    assert summary["torque_time_nms"] > 0 and summary["torque_peak_nm"] > 0
    assert summary["dose_is_bound"] == (summary["doubtful_pulses"] > 0)
    assert summary["dose_is_bound"] == any(words.startswith("dose: ") for words in summary["warnings"])
    refused = client.ask("start", plan=short_plan("next"))
    assert refused["problem"]["code"] == "uncertain"
    assert client.rearm("nurse")["ok"]
    client.ask("subscribe")
    assert client.start(short_plan("next"))["ok"]
    assert client.wait_finished("next")["outcome"] == "completed"


def test_lost_samples_are_found_and_marked(shared: tuple[Bench, RigClient]):
    bench, client = shared
    client.ask("subscribe")
    assert bench.fault(cmd="fault", name="frames_dropped", on=True, probability=0.02)["ok"]
    assert client.start(short_plan("gaps"))["ok"]
    event = client.wait_finished("gaps")
    bench.fault(cmd="fault", name="frames_dropped", on=False)
    assert event["outcome"] == "completed"
    with h5py.File(event["recording_path"]) as file:
        gaps, counter = file["torque/gaps"][:], file["torque/counter"][:]
        steps = np.diff(counter)
        assert np.array_equal(gaps[:, 0], np.flatnonzero(steps > 1) + 1)
        assert np.array_equal(gaps[:, 1], steps[steps > 1] - 1)
        assert 40 < gaps[:, 1].sum() < 400
        assert np.allclose(np.diff(file["torque/time_s"][:]), steps / 1600, rtol=0.01)


def test_two_rigs_cannot_share_the_data_or_the_port(shared: tuple[Bench, RigClient]):
    bench, client = shared
    with pytest.raises(RuntimeError, match="another rig"):
        bench.start_rig()
    assert client.status()["state"] == "ready"  # the first is none the worse for it
