"""The rig on the wire: a whole test, a calibration, stops and faults."""

from __future__ import annotations

import hashlib
import json
import signal
import time
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.rig import archive
from stimrig.rig.acquire.run import CLIMB
from stimrig.rig.config import EMULATOR_WATCH
from stimrig.rig.control.sealing import MAY_BE_FELT
from stimrig.rig.messages import LiveEvent
from stimrig.rig.signals import PulseStatus
from tests.harness.processes import Bench, RigClient, default_plan, kill_hard, later, short_plan

pytestmark = pytest.mark.wire

RATE_HZ = 40.0
SAME_CLOCK_S = 2e-4
"""Two processes read the same clock; between the device's doing and its answer is at least this."""
WIDTHS = "pulse_width_us", "sent_pulse_width_us"
FAULTS = {"cell_silent": "load cell", "stimulator_unplugged": "stimulator"}
STEPS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.4}},
    {"name": "steps", "sequence": "steps", "settings": {"on_s": 30.0, "off_s": 0.0}},
]


def start(bench: Bench, client: RigClient, test_id: str = "t") -> RigClient:
    client.ask("subscribe")
    before = bench.state()["pulses_received"]
    reply = client.start(default_plan(test_id, segments=STEPS))
    assert reply["ok"], reply
    client.wait_state("running")
    end = time.monotonic() + 60
    while bench.state()["pulses_received"] < before + 20:
        assert time.monotonic() < end, client.status()
        time.sleep(0.02)
    return client


def check_kept(event: dict[str, Any], outcome: str) -> None:
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
    start(bench, client, fault)
    injected = bench.fault(cmd="fault", name=fault, on=True)
    assert injected["ok"], injected
    counted = bench.state()["pulses_received"]
    event = client.wait_finished(fault)
    check_kept(event, "fault")
    assert FAULTS[fault] in event["reason"]
    # pulses are counted, not seconds: a computer that stands still sends none
    watch_s = EMULATOR_WATCH["stale_torque_s"] if fault == "cell_silent" else 0.0
    assert bench.state()["pulses_received"] - counted <= RATE_HZ * (watch_s + 0.25)
    status = client.wait_state("latched")
    assert status["reason"].startswith(event["reason"])  # what its reader finds after the end comes behind
    refused = client.ask("start", plan=short_plan("refused"))
    assert refused["problem"]["code"] == "latched"
    bench.fault(cmd="fault", name=fault, on=False)
    later(bench)
    rearmed = client.rearm("nurse")
    assert rearmed["ok"], rearmed
    assert rearmed["body"]["state"] == "ready"


@pytest.mark.parametrize("fault", ["cell_silent", "error_frames"])
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
        assert client.wait_finished(test_id)["outcome"] == "fault"
    # also where the rest between two tests left the rig the time to find it silent
    reason = client.status()["reason"] if reply["ok"] else reply["problem"]["detail"]
    assert "load cell" in reason and "look at its plug and supply, and at the CAN adapter" in reason, reply
    assert bench.state()["pulses_received"] == before
    bench.fault(cmd="fault", name=fault, on=False)
    later(bench)
    assert client.rearm("nurse")["body"]["state"] == "ready"


def felt_after(bench: Bench, time_s: float) -> int:
    """How many pulses the emulated electrodes felt after a monotonic time."""
    return sum(pulse["monotonic_s"] > time_s for pulse in bench.felt())


def stops_when_asked(bench: Bench, client: RigClient) -> float:
    """Confirmed by device and torque, latched, re-armed; milliseconds from request to last pulse."""
    start(bench, client, "asked")
    asked_s = time.monotonic()
    evidence = client.ask("stop", reason="enough", by="nurse")["body"]
    answered_s = time.monotonic()
    assert evidence["confirmed"], evidence
    event = client.wait_finished("asked")
    assert event["outcome"] == "stopped"
    assert client.wait_state("latched")["reason"] == "enough (by nurse)"
    assert client.rearm("nurse")["ok"]
    with h5py.File(event["recording_path"]) as file:
        told = json.loads(file.attrs["events"])
    # the rig's clock goes on while the machine sleeps; a pause between two looks at both makes their difference smaller
    ahead_s = max(time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic() for _ in range(5))
    taken_s = next(one["time_s"] for one in told if one["event"] == "stopped") - ahead_s
    assert asked_s - SAME_CLOCK_S <= taken_s <= answered_s + SAME_CLOCK_S
    # how soon a request is taken is the machine's doing, and a figure of the campaign
    assert felt_after(bench, taken_s + SAME_CLOCK_S) <= 1  # a command may have been on its way
    assert felt_after(bench, answered_s + SAME_CLOCK_S) == 0
    return 1e3 * (bench.felt()[-1]["monotonic_s"] - asked_s)


def test_stop_is_confirmed_by_device_and_torque(shared: tuple[Bench, RigClient]):
    stops_when_asked(*shared)


def test_a_killed_rig_sends_no_more_and_comes_back_uncertain(shared: tuple[Bench, RigClient]):
    bench, client = shared
    before, received = len(bench.felt()), bench.state()["pulses_received"]
    start(bench, client, "killed")
    assert bench.rig is not None
    kill_hard(bench.rig)
    killed_s = bench.state()["time_s"]
    count = later(bench)["pulses_received"] - received
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
    felt = bench.felt()[before:]
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


def test_a_signal_stops_stimulation_first_and_seals(shared: tuple[Bench, RigClient]):
    bench, client = shared
    recordings = bench.data / "recordings"
    before = set(recordings.glob("*.h5"))
    start(bench, client)
    assert bench.rig is not None
    assert bench.rig.stop(signal.SIGTERM, timeout_s=120.0) == 0
    count = bench.state()["pulses_received"]
    assert later(bench)["pulses_received"] == count
    (sealed,) = set(recordings.glob("*.h5")) - before
    with h5py.File(sealed) as file:
        assert file.attrs["outcome"] == "stopped"
    client = bench.start_rig()  # what stopped it is remembered
    assert client.status()["state"] == "latched"
    assert "shutting down" in client.status()["reason"]


STOOD_S = 0.15
"""With what a shared machine may stand still by itself less than a second in all."""


def stand_still(bench: Bench, for_s: float) -> int:
    """Stop the rig's process for a while; how many pulses were felt until then."""
    assert bench.rig is not None
    bench.rig.popen.send_signal(signal.SIGSTOP)
    time.sleep(for_s)
    felt = len(bench.felt())
    bench.rig.popen.send_signal(signal.SIGCONT)
    return felt


@pytest.mark.campaign  # tests/rig/test_pauses.py does it in virtual time
def test_a_rig_that_stands_still_goes_on_and_loses_no_sample_and_then_ends_its_test(shared: tuple[Bench, RigClient]):
    bench, client = shared
    before = len(bench.felt())
    start(bench, client, "short")
    for _ in range(3):
        stand_still(bench, STOOD_S)
        time.sleep(0.5)
    event = client.wait_finished("short")
    assert (event["outcome"], event["summary"]["lost_samples"]) == ("completed", 0), event["reason"]
    pauses = event["summary"]["pauses"]
    assert sum(pause["for_s"] for pause in pauses) >= 3 * (STOOD_S - 0.03), "two that follow one another may be one"
    with h5py.File(Path(event["recording_path"])) as file:
        status, sent_us = file["pulses/status"][:], file["pulses/sent_pulse_width_us"][:]
        planned_s = file["pulses/planned_time_s"][:]
    assert np.sum(status == PulseStatus.DROPPED) >= 3 * round(RATE_HZ * (STOOD_S - 0.03))
    for pause in pauses:  # after each the width climbs from nothing
        after = np.flatnonzero((planned_s > pause["at_s"]) & np.isfinite(sent_us))[:1]
        assert len(after) and sent_us[after[0]] <= 50
    assert all(two["time_s"] - one["time_s"] >= 0.008 for one, two in pairwise(bench.felt()[before:]))
    start(bench, client, "long")
    felt = stand_still(bench, 1.2 + EMULATOR_WATCH["stale_torque_s"])
    event = client.wait_finished("long")
    assert event["outcome"] == "fault" and "the computer was blocked for" in event["reason"]
    assert len(bench.felt()) == felt
    assert client.status()["state"] == "latched"


def check_recording(event: dict[str, Any], felt: list[dict[str, Any]]) -> dict[str, float]:
    """A completed test's file is whole, hashed, and agrees with what the electrodes felt; a few figures."""
    assert event["outcome"] == "completed", event
    path, summary = Path(event["recording_path"]), event["summary"]
    assert hashlib.sha256(path.read_bytes()).hexdigest() == event["file_sha256"]
    with h5py.File(path) as file:
        assert archive.verify(path) == file.attrs["content_sha256"]
        assert json.loads(file.attrs["configuration"])["plan"]["test_id"] == event["test_id"]
        status, planned, sent = (file[f"pulses/{name}"][:] for name in ("status", *WIDTHS))
        torque_nm, time_s, counter = (file[f"torque/{name}"][:] for name in ("torque_nm", "time_s", "counter"))
        ack_s = (file["pulses/acknowledged_time_s"][:] - file["pulses/written_time_s"][:])[status == 0]
    assert [p["width_us"] for p in felt] == sent[status == 0].tolist()
    assert {p["current_ma"] for p in felt} == {20.0}
    assert all(p["balanced"] for p in felt)
    assert set(np.unique(status)) <= {0, 1, 2}  # how many are dropped is the machine's doing: a figure of the bench
    assert np.sum(status == 2) == summary["dropped_pulses"]
    assert np.all(planned[status == 1] < 20)
    whole, felt_at = np.trunc(planned), np.flatnonzero(status == 0)
    dropped = np.flatnonzero(status == 2)  # after each the width may have to climb back
    as_planned = [at for at in felt_at if not np.any((dropped < at) & (dropped >= at - 2 * CLIMB))]
    assert np.array_equal(sent[as_planned], whole[as_planned])
    assert np.all(sent[felt_at] <= whole[felt_at])
    assert np.median(ack_s) > 0  # how soon they are heard is a figure of the campaign
    assert len(time_s) > 0.95 * 1600 * summary["duration_s"]
    assert np.all(np.diff(time_s) > 0) and (counter[0] < 0 or np.all(np.diff(counter) == 1))
    assert summary["lost_samples"] == 0
    assert np.max(torque_nm) > 1.0
    assert abs(np.median(torque_nm[time_s < 0.4])) < 0.2 * np.max(torque_nm)  # a stop just before may still be felt
    return {
        "align_ms": summary["alignment"]["error_ms"],
        "ack_ms": 1e3 * float(np.median(ack_s)),
        "dropped_percent": 100 * float(np.mean(status[status != 1] == 2)),
    }


def test_what_is_shown_and_sealed_is_what_was_felt(shared: tuple[Bench, RigClient]):
    bench, client = shared
    before = len(bench.felt())
    client.ask("subscribe")
    while client.events.get(timeout=60)["event"] != "state":
        pass
    live = client.events.get(timeout=60)
    assert live["event"] == "live"
    assert live["test_id"] is None
    assert len(list(LiveEvent.model_validate(live).torque_rows())) > 0
    assert client.start(short_plan("whole"))["ok"]
    events, end = [], time.monotonic() + 90
    while not events or events[-1]["event"] != "finished":
        events.append(client.events.get(timeout=end - time.monotonic()))
    states = [e["status"]["state"] for e in events if e["event"] == "state"]
    assert states[:4] == ["arming", "running", "sealing", "ready"], events[-1]
    told = [LiveEvent.model_validate(e) for e in events if e["event"] == "live" and e["test_id"] == "whole"]
    with h5py.File(events[-1]["recording_path"]) as file:
        sent_us = np.nan_to_num(file["pulses/sent_pulse_width_us"][:])
        segments = list(
            zip(file["segments/name"].asstr(), file["segments/start_s"], file["segments/end_s"], strict=True)
        )
        torque_nm = dict(zip(file["torque/counter"][:].tolist(), file["torque/torque_nm"][:].tolist(), strict=True))
    outcomes = [one for e in told for one in zip(e.outcomes.index, e.outcomes.pulse_width_us, strict=True)]
    assert len(dict(outcomes)) == len(outcomes) > 100
    assert all(width_us == sent_us[index] for index, width_us in outcomes)
    for e in told:
        at = [name for name, start_s, end_s in segments if start_s <= e.elapsed_s < end_s]
        assert [e.segment] == (at or [None])
    shown = {counter: nm for e in told for _, _, nm, counter, _ in e.torque_rows() if counter in torque_nm}
    assert len(shown) > 1600 and shown.items() <= torque_nm.items()
    check_recording(events[-1], bench.felt()[before:])


def test_a_calibration_from_start_to_a_test(shared: tuple[Bench, RigClient]):
    """The electrodes feel what was asked for, and nothing between the steps."""
    bench, client = shared
    before = len(bench.felt())
    asked = {"calibration_id": "cal", "participant": "P01", "by": "therapist"}
    reply = client.ask("calibrate-start", **asked, step_us=25.0, train_s=0.25, max_pulse_width_us=80.0)
    assert reply["ok"], reply
    assert reply["body"]["state"] == "calibrating"
    assert len(bench.felt()) == before  # opening sends nothing
    assert client.ask("start", plan=short_plan("no"))["problem"]["code"] == "busy"
    shown = {"pulse_width_us": 0}
    for threshold, width_us in (("sensory", 25), ("motor", 50), ("comfort", 75)):
        while shown["pulse_width_us"] < width_us:  # a train that was lost to a busy machine is sent again
            reply = client.ask("calibrate-step", direction="up")
            assert reply["ok"], reply
            status = client.wait_state("calibrating", "latched")
            assert status["state"] == "calibrating", status
            shown = status["calibration"]
        reply = client.ask("calibrate-mark", threshold=threshold)
        assert reply["body"]["calibration"]["marks_us"][threshold] == shown["pulse_width_us"]
    pulses = [round(p["width_us"]) for p in bench.felt()[before:]]
    trains = shown["trains"]
    assert all(t["pulses"] <= 10 for t in trains), trains
    # one that was not felt whole is sent again; after a pause of the computer its pulses climb
    widths_us = [width_us for width_us, _ in groupby(t["pulse_width_us"] for t in trains if t["pulses"])]
    assert widths_us == [25, 50, 75]
    assert set(widths_us) <= set(pulses) and max(pulses) == 75
    result = client.ask("calibrate-finish", by="therapist")["body"]
    waiting = client.status()["calibrated"]
    assert waiting["result"] == result
    assert client.ask("calibrate-stored", calibration_id=waiting["calibration_id"])["body"]["calibrated"] is None
    profile = result["profile"]
    assert profile["max_pulse_width_us"] == 75.0
    acknowledged = 0
    for train, path in zip(trains, result["recordings"], strict=True):
        with h5py.File(path) as file:
            assert file.attrs["kind"] == "calibration"
            status = file["pulses/status"][:]
        sure = int(np.sum(status == PulseStatus.ACKNOWLEDGED))
        assert sure <= train["pulses"] == int(np.isin(status, MAY_BE_FELT).sum())  # what may be felt counts as felt
        assert train["pulses"] - sure <= 1  # none follows one that is not acknowledged
        acknowledged += sure
    # one that was not acknowledged need not have been felt
    assert acknowledged <= len(pulses) <= sum(train["pulses"] for train in trains)
    client.ask("subscribe")
    ramp = [{"name": "ramp", "sequence": "ramp", "settings": {"up_s": 0.5, "down_s": 0.5}}]
    assert client.start(short_plan("calibrated", profile=profile, segments=ramp))["ok"]
    assert client.wait_finished("calibrated")["outcome"] == "completed"
    old = profile | {"expires_at_utc": profile["set_at_utc"]}
    assert client.ask("start", plan=short_plan("old", profile=old))["problem"]["code"] == "refused"
