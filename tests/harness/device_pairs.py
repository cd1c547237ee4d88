"""What every pair of devices must do, whatever its protocol: one suite for one pair and for all of them."""

from __future__ import annotations

import time
from pathlib import Path

import h5py
import numpy as np

from stimrig.hardware_sim import load_cells, stimulators
from stimrig.rig import archive
from tests.harness.processes import Bench, RigClient, kill_hard, short_plan

SAME_CLOCK_S = 2e-4
"""Two processes read the same clock; between the device's doing and its answer is at least this."""

STIMULATORS = tuple(stimulators.STIMULATORS)
TRANSPORTS = tuple(load_cells.TRANSPORTS)
CELLS = {
    f"{name} x{count}" if count > 1 else name: ("--cell", name, "--samples-per-frame", str(count))
    for name, cell in load_cells.CELLS.items()
    for count in {min(cell.layouts), max(cell.layouts)}
}
"""Every emulated cell with its fewest and its most samples per frame, as options of the emulator."""
HOLD = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 0.5}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 8.0, "off_s": 0.0, "repeats": 1}},
]


def options(stimulator: str, cell: str, transport: str) -> list[str]:
    """Of the emulator."""
    return ["--stimulator", stimulator, "--load-cell", transport, *CELLS[cell], "--noise-seed", "7"]


def felt_after(bench: Bench, time_s: float) -> int:
    """How many pulses the emulated electrodes felt after a monotonic time."""
    return sum(pulse["monotonic_s"] > time_s for pulse in bench.felt())


def check_all(bench: Bench) -> dict[str, float]:
    """The whole suite on one pair; a few figures."""
    client = bench.start_rig()
    client.ask("subscribe")
    figures = plays_and_records(bench, client)
    figures["stop_ms"] = stops_when_asked(bench, client)
    figures["fault_ms"] = stops_when_unheard(bench, client)
    figures["silence_ms"] = says_nothing_when_killed(bench, client)
    return figures


def plays_and_records(bench: Bench, client: RigClient) -> dict[str, float]:
    """A test ends well, and the file holds what the electrodes felt and the muscle gave."""
    reply = client.start(short_plan("plays"))
    assert reply["ok"], reply
    event = client.wait_finished("plays")
    assert event["outcome"] == "completed", event
    with h5py.File(event["recording_path"]) as file:
        assert archive.verify(Path(event["recording_path"])) == file.attrs["content_sha256"]
        status, sent = file["pulses/status"][:], file["pulses/sent_pulse_width_us"][:]
        torque_nm, time_s = file["torque/torque_nm"][:], file["torque/time_s"][:]
        ack_s = (file["pulses/acknowledged_time_s"][:] - file["pulses/written_time_s"][:])[status == 0]
    fired = bench.felt()
    assert [p["width_us"] for p in fired] == sent[status == 0].tolist()
    assert {p["current_ma"] for p in fired} == {20.0}
    assert all(p["balanced"] for p in fired)
    assert set(np.unique(status)) <= {0, 1, 2}  # how many are dropped is the machine's doing: a figure of the bench
    assert np.sum(status == 2) == event["summary"]["dropped_pulses"]
    assert np.sum(status == 0) >= 20
    assert 0 < np.median(ack_s) < 0.01  # one that is heard after 25 ms drops the next pulse
    assert len(time_s) > 0.95 * 1600 * event["summary"]["duration_s"]
    assert np.all(np.diff(time_s) > 0)
    assert event["summary"]["lost_samples"] == 0
    assert np.max(torque_nm) > 1.0
    assert abs(np.median(torque_nm[time_s < 0.4])) < 0.2
    error_ms = event["summary"]["alignment"]["error_ms"]
    assert error_ms is not None
    assert error_ms < 1.0
    return {
        "align_ms": error_ms,
        "ack_ms": 1e3 * float(np.median(ack_s)),
        "dropped_percent": 100 * float(np.mean(status[status != 1] == 2)),
    }


def holding(bench: Bench, client: RigClient, name: str) -> None:
    """A test that stimulates steadily."""
    before = len(bench.felt())
    reply = client.start(short_plan(name, segments=HOLD))
    assert reply["ok"], reply
    end_s = time.monotonic() + 15
    while len(bench.felt()) < before + 20:
        assert time.monotonic() < end_s, client.status()
        time.sleep(0.02)


def stops_when_asked(bench: Bench, client: RigClient) -> float:
    """Confirmed by device and torque, latched, re-armed; milliseconds from request to last pulse."""
    holding(bench, client, "asked")
    asked_s = time.monotonic()
    evidence = client.ask("stop", reason="enough", by="nurse")["body"]
    answered_s = time.monotonic()
    assert evidence["confirmed"], evidence
    assert client.wait_finished("asked")["outcome"] == "stopped"
    assert client.wait_state("latched")["reason"] == "enough (by nurse)"
    assert client.rearm("nurse")["ok"]
    assert felt_after(bench, asked_s) <= 4  # of 25 ms each
    assert felt_after(bench, answered_s + SAME_CLOCK_S) == 0
    return 1e3 * (bench.felt()[-1]["monotonic_s"] - asked_s)


def stops_when_unheard(bench: Bench, client: RigClient) -> float:
    """No acks: stopped, told, kept; milliseconds from the fault to the last pulse."""
    holding(bench, client, "unheard")
    injected = bench.fault(cmd="fault", name="no_ack", on=True)
    event = client.wait_finished("unheard")
    assert event["outcome"] == "fault"
    assert "not acknowledged" in event["reason"]
    # no pulse goes out before the one ahead of it is acknowledged
    assert felt_after(bench, injected["monotonic_s"]) <= 1
    last_ms = 1e3 * (bench.felt()[-1]["monotonic_s"] - injected["monotonic_s"])
    bench.fault(cmd="fault", name="no_ack", on=False)
    client.wait_state("latched")
    time.sleep(0.1)
    rearmed = client.rearm("nurse")
    assert rearmed["ok"], rearmed
    return last_ms


def says_nothing_when_killed(bench: Bench, client: RigClient) -> float:
    """The host's death ends stimulation at once: each pulse was a command. Then uncertain, asked, not resumed."""
    holding(bench, client, "killed")
    assert bench.rig is not None
    kill_hard(bench.rig)
    died_s = time.monotonic()
    time.sleep(1.5 / bench.speed)  # longer than any device's own watchdog
    after = bench.felt()
    assert felt_after(bench, died_s) <= 1  # a command may have been on its way
    again = bench.start_rig()
    assert again.status()["state"] == "uncertain"
    again.ask("subscribe")
    assert len(bench.felt()) == len(after)
    assert again.rearm("nurse")["ok"]
    assert again.start(short_plan("next"))["ok"]
    event = again.wait_finished("next")
    assert event["outcome"] == "completed", event
    return 1e3 * (after[-1]["monotonic_s"] - died_s)
